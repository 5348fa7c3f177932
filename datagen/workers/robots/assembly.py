"""Assembly of a robot: the URDF's links from the mount to the flange, scaled, with the hand on it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from datagen.schemas.errors import InputError
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.transforms import translation
from datagen.workers.robots.description import HandDescription, Parts, RobotDescription, robots_folder
from datagen.workers.robots.hulls import shape_parts
from datagen.workers.robots.urdf import Inertial, Joint, Link, Shape, UrdfTree, read_urdf, scaled_inertial

_TUBE_SIDES = 12
_REACH_TOLERANCE_M = 1e-6


@dataclass(frozen=True, eq=False)
class LinkBody:
    """A link with a shape, together with all links that are fixed to it."""

    name: str
    inertial: Inertial | None
    parts_m: Parts  # link frame
    visuals: tuple[Shape, ...]  # visual meshes, link frame, unscaled
    scale: float
    drawn_m: Parts  # parts to draw where there are no visuals


@dataclass(frozen=True, eq=False)
class Assembly:
    """Bodies 0 (root), 1..A (arm), then palm and two fingers. Joint k moves body k + 1."""

    bodies: tuple[LinkBody, ...]
    arm: tuple[Joint, ...]  # (A,), with scaled origins; names of parent and child are those of bodies
    palm: Joint
    fingers: tuple[Joint, Joint]
    T_root_mount: F64  # (4, 4)
    T_palm_tcp: F64
    reach_m: float
    wrist_reach_m: float  # largest distance of the last joint from the first
    scale: float


def assemble(description: RobotDescription, reach_m: float | None, lift_m: float) -> Assembly:
    """Read the URDFs and assemble the robot.

    `reach_m` is for a robot that is scaled to its reach; `lift_m` for one with a torso. Raises InputError
    naming the file and what is wrong in it.
    """
    tree = read_urdf(robots_folder() / description.urdf)
    same = description.hand.urdf == description.urdf
    hand = tree if same else read_urdf(robots_folder() / description.hand.urdf)
    held = dict(description.held)
    if description.lift:
        held[description.lift.joint] = lift_m
    heads = (description.root_link, *(tree.joint(name).child for name in description.arm_joints))
    hand_mount = tree.joint_above(description.hand.palm_link)
    stops = {*description.arm_joints, *([hand_mount.name] if hand_mount else [])}
    for name in description.shapeless:
        tree.links[name] = replace(tree.link(name), collisions=(), visuals=())
    clusters = [_cluster(tree, head, stops, held) for head in heads]
    scale, extension_m = 1.0, 0.0
    if description.extension is not None and reach_m is not None:
        rule = description.extension
        share = (rule.none_from_reach_m - reach_m) / (rule.none_from_reach_m - description.limits.reach_m[0])
        extension_m = rule.longest_m * min(max(share, 0.0), 1.0)
        scale = _scale_for(description, tree, clusters, extension_m, reach_m)
    arm, palm, chain = _joints(description, tree, clusters, scale, extension_m)
    unscaled = _joints(description, tree, clusters, 1.0, 0.0)[2]
    links = [
        _body(tree.path, head, cluster, scale, description.cuts_m)
        for head, cluster in zip(heads, clusters, strict=True)
    ]
    if extension_m > 0.0:
        assert description.extension is not None
        T_flange = _scaled_pose(clusters[-1][description.flange_link][1], scale)
        tube = _tube(T_flange, extension_m, description.extension.radius_m)
        last = links[-1]
        links[-1] = replace(
            last,
            parts_m=(*last.parts_m, tube),
            drawn_m=(*last.drawn_m, tube),
        )
    fingers = _fingers(hand, description.hand)
    names = (description.hand.palm_link, *(joint.child for joint in fingers))
    links += [_body(hand.path, name, {name: (hand.link(name), np.eye(4))}, 1.0, {}) for name in names]
    mount = tree.joint(description.arm_joints[0])
    T_root_mount = np.eye(4)
    if description.lift:
        # With a torso the mount is the origin of the first joint; elsewhere it is the root link.
        T_root_mount[:3, 3] = (clusters[0][mount.parent][1] @ mount.T_parent_child)[:3, 3]
    return Assembly(
        tuple(links),
        arm,
        palm,
        fingers,
        T_root_mount,
        description.hand.T_palm_tcp,
        largest_reach_m(chain),
        scale * largest_reach_m(replace(unscaled, tcp_m=np.zeros(3))),
        scale,
    )


_Cluster = dict[str, tuple[Link, F64]]  # links that are fixed to the head, with their poses in its frame


def _cluster(tree: UrdfTree, head: str, stops: set[str], held: dict[str, float]) -> _Cluster:
    found: _Cluster = {head: (tree.link(head), np.eye(4))}
    waiting = [head]
    while waiting:
        parent = waiting.pop()
        for joint in tree.children(parent):
            if joint.name in stops:
                continue
            if joint.kind != "fixed" and joint.name not in held:
                fix = "Name it in the robot's file, or use the URDF that ManiSkill brings"
                raise InputError(tree.path, f"joint {joint.name}", "has no fixed position", fix)
            T = found[parent][1] @ joint.T_parent_child
            if joint.kind == "prismatic":
                T = T @ translation(*(joint.axis * held[joint.name]))
            found[joint.child] = (tree.link(joint.child), T)
            waiting.append(joint.child)
    return found


def _joints(
    description: RobotDescription, tree: UrdfTree, clusters: list[_Cluster], scale: float, extension_m: float
) -> tuple[tuple[Joint, ...], Joint, Chain]:
    heads = [next(iter(cluster)) for cluster in clusters]
    arm: list[Joint] = []
    for k, name in enumerate(description.arm_joints):
        joint = tree.joint(name)
        if joint.kind not in ("revolute", "continuous"):
            raise _wrong(tree.path, f"joint {name}", f"is {joint.kind}; joints of an arm turn")
        if joint.parent not in clusters[k]:
            raise _wrong(tree.path, f"joint {name}", f"does not follow {heads[k]}")
        T = _scaled_pose(clusters[k][joint.parent][1] @ joint.T_parent_child, scale)
        # Half a turn each way reaches every pose of a joint that turns freely.
        lower, upper = max(joint.lower, -2 * np.pi), min(joint.upper, 2 * np.pi)
        if joint.kind == "continuous":
            lower, upper = -np.pi, np.pi
        arm.append(
            replace(joint, kind="revolute", parent=heads[k], T_parent_child=T, lower=lower, upper=upper)
        )
    if description.flange_link not in clusters[-1]:
        raise _wrong(tree.path, f"link {description.flange_link}", f"is not fixed to {heads[-1]}")
    T_flange = _scaled_pose(clusters[-1][description.flange_link][1], scale)
    T_palm = T_flange @ translation(0.0, 0.0, extension_m) @ description.T_flange_palm
    palm = Joint(
        "hand_mount", "fixed", heads[-1], description.hand.palm_link, T_palm, np.array([0.0, 0.0, 1.0]),
        0.0, 0.0, 0.0, 0.0,
    )  # fmt: skip
    chain = Chain(
        np.stack([joint.T_parent_child for joint in arm]),
        np.stack([joint.axis for joint in arm]),
        np.array([joint.lower for joint in arm]),
        np.array([joint.upper for joint in arm]),
        (T_palm @ description.hand.T_palm_tcp)[:3, 3],
    )
    return tuple(arm), palm, chain


def _scale_for(
    description: RobotDescription,
    tree: UrdfTree,
    clusters: list[_Cluster],
    extension_m: float,
    reach_m: float,
) -> float:
    """The scale at which the arm reaches `reach_m`, by the secant method: reach is nearly linear in it."""

    def reach_at(scale: float) -> float:
        return largest_reach_m(_joints(description, tree, clusters, scale, extension_m)[2])

    low, high = 0.1, 1.0
    at_low, at_high = reach_at(low), reach_at(high)
    for _ in range(20):
        if at_high == at_low:
            break
        guess = low + (reach_m - at_low) * (high - low) / (at_high - at_low)
        at_guess = reach_at(guess)
        if abs(at_guess - reach_m) < _REACH_TOLERANCE_M:
            return guess
        low, at_low, high, at_high = high, at_high, guess, at_guess
    raise _wrong(tree.path, "joints", f"no scale gives a reach of {reach_m} m")


def _body(
    path: Path, name: str, cluster: _Cluster, scale: float, cuts_m: Mapping[str, tuple[float, ...]]
) -> LinkBody:
    parts: list[F32] = []
    visuals: list[Shape] = []
    for link, T in cluster.values():
        for shape in link.collisions:
            parts += shape_parts(_placed(shape, T), scale, cuts_m.get(link.name, ()))
        visuals += (_placed(shape, T) for shape in link.visuals)
    if not parts:
        raise _wrong(path, f"link {name}", "has no collision shape")
    inertial = _combined([(link.inertial, T) for link, T in cluster.values() if link.inertial])
    if inertial is not None:
        inertial = scaled_inertial(inertial, scale)
    # Visual meshes are read from glTF alone; hulls replace those of other formats.
    if any(shape.mesh is None or shape.mesh.suffix != ".glb" for shape in visuals):
        visuals = []
    drawn = () if visuals else tuple(parts)
    return LinkBody(name, inertial, tuple(parts), tuple(visuals), scale, drawn)


def _placed(shape: Shape, T: F64) -> Shape:
    return replace(shape, T_link_shape=T @ shape.T_link_shape)


def _combined(inertials: list[tuple[Inertial, F64]]) -> Inertial | None:
    """One body of several that are fixed together, in the head's frame (parallel axis theorem)."""
    if not inertials:
        return None
    mass = sum(i.mass_kg for i, _ in inertials)
    centres = [T[:3, :3] @ i.centre_m + T[:3, 3] for i, T in inertials]
    centre = np.sum([i.mass_kg * c for (i, _), c in zip(inertials, centres, strict=True)], axis=0) / mass
    inertia = np.zeros((3, 3))
    for (i, T), c in zip(inertials, centres, strict=True):
        d = c - centre
        R = T[:3, :3]
        inertia += R @ i.inertia_kgm2 @ R.T + i.mass_kg * (d @ d * np.eye(3) - np.outer(d, d))
    return Inertial(mass, centre, inertia)


def _tube(T_flange: F64, length_m: float, radius_m: float) -> F32:
    angle = 2 * np.pi * (np.arange(_TUBE_SIDES) + 0.5) / _TUBE_SIDES
    outer = radius_m / np.cos(np.pi / _TUBE_SIDES)  # the prism's sides touch the tube from outside
    ring = np.stack([outer * np.cos(angle), outer * np.sin(angle), np.zeros(_TUBE_SIDES)], axis=1)
    points = np.concatenate([ring, ring + (0.0, 0.0, length_m)])
    return (points @ T_flange[:3, :3].T + T_flange[:3, 3]).astype(np.float32)


def _fingers(hand: UrdfTree, description: HandDescription) -> tuple[Joint, Joint]:
    left, right = (hand.joint(name) for name in description.finger_joints)
    R = description.T_palm_tcp[:3, :3]
    for joint, side in ((left, 1.0), (right, -1.0)):
        where = f"joint {joint.name}"
        if joint.kind != "prismatic" or joint.parent != description.palm_link:
            raise _wrong(hand.path, where, f"does not slide on {description.palm_link}")
        if joint.lower > 0.0 or joint.upper < 1e-3:
            raise _wrong(
                hand.path, where, f"its range {joint.lower} to {joint.upper} m does not open the hand"
            )
        if not np.allclose(R.T @ joint.T_parent_child[:3, :3] @ joint.axis, (0.0, side, 0.0), atol=1e-6):
            raise _wrong(hand.path, where, "does not move along y of the TCP")
    if abs(left.upper - right.upper) > 1e-9:
        raise _wrong(hand.path, f"joint {right.name}", "opens less or more than the other finger")
    return left, right


def _scaled_pose(T: F64, scale: float) -> F64:
    out = T.copy()
    out[:3, 3] *= scale
    return out


def _wrong(path: Path, field: str, problem: str) -> InputError:
    return InputError(path, field, problem, "Use the URDF of ManiSkill, or correct the file")


_STARTS = 32
_SWEEPS = 200
_SETTLED_M = 1e-9


@dataclass(frozen=True, eq=False)
class Chain:
    """Revolute joints from a base to a point, the TCP."""

    T_parent_joint: F64  # (A, 4, 4), joint frames at zero in the frame before
    axis: F64  # (A, 3), unit, joint frame
    lower_rad: F64  # (A,)
    upper_rad: F64  # (A,)
    tcp_m: F64  # (3,), in the last joint's frame


def largest_reach_m(chain: Chain) -> float:
    """The largest distance from the first joint's origin to the TCP within the limits, metres.

    Coordinate ascent from 32 fixed starts. Turning one joint alone moves the TCP on a circle, and its
    squared distance to any fixed point is a + b cos(q - c), so each step is exact.
    """
    parts = (chain.T_parent_joint, chain.axis, chain.lower_rad, chain.upper_rad, chain.tcp_m)
    return _largest_reach_m(*(part.tobytes() for part in parts))


# Scaled arms need the same chains again: the bounds of the search for their scale, and its result.
@lru_cache(maxsize=256)
def _largest_reach_m(*parts: bytes) -> float:
    T, axes, lower_rad, upper_rad, tcp_m = map(np.frombuffer, parts)
    chain = Chain(T.reshape(-1, 4, 4), axes.reshape(-1, 3), lower_rad, upper_rad, tcp_m)
    count = len(chain.axis)
    rng = np.random.Generator(np.random.PCG64(0))
    lower, upper = np.maximum(chain.lower_rad, -np.pi), np.minimum(chain.upper_rad, np.pi)
    q = rng.uniform(lower, upper, (_STARTS, count))  # (S, A)
    best = np.zeros(_STARTS)
    cross = [_cross_matrix(axis) for axis in chain.axis]
    for _ in range(_SWEEPS):
        # The TCP in each joint's own frame, before that joint turns: (S, 3) for every joint.
        points = [np.broadcast_to(chain.tcp_m, (_STARTS, 3))]
        for k in range(count - 1, 0, -1):
            T = chain.T_parent_joint[k]
            points.append(_turned(points[-1], chain.axis[k], cross[k], q[:, k]) @ T[:3, :3].T + T[:3, 3])
        points.reverse()
        shoulder = np.zeros((_STARTS, 3))  # in the frame of joint k, after it has turned
        for k in range(1, count):
            T = chain.T_parent_joint[k]
            seen = (shoulder - T[:3, 3]) @ T[:3, :3]  # in the frame of joint k before it turns
            axis, tcp = chain.axis[k], points[k]
            flat = tcp - (tcp @ axis)[:, None] * axis
            b = np.sum(flat * seen, axis=1)
            c = np.sum(flat @ cross[k] * seen, axis=1)
            # Distance^2 = const - 2 (b cos q + c sin q): largest opposite to the angle of (b, c).
            free = np.arctan2(-c, -b)
            ends = np.stack([np.full(_STARTS, lower[k]), np.full(_STARTS, upper[k])])
            near = [-(b * np.cos(e) + c * np.sin(e)) for e in ends]
            bound = np.where(near[0] >= near[1], lower[k], upper[k])
            q[:, k] = np.where((free >= lower[k]) & (free <= upper[k]), free, bound)
            shoulder = _turned(seen, axis, cross[k], -q[:, k])
        distance = np.linalg.norm(shoulder - chain.tcp_m, axis=1)
        if np.max(distance - best) < _SETTLED_M:
            break
        best = np.maximum(best, distance)
    return float(best.max())


def _turned(points: F64, axis: F64, cross: F64, angle_rad: F64) -> F64:
    """Points (S, 3) turned about an axis by an angle each (Rodrigues' formula)."""
    c, s = np.cos(angle_rad)[:, None], np.sin(angle_rad)[:, None]
    return points * c + points @ cross * s + (points @ axis)[:, None] * axis * (1 - c)


def _cross_matrix(axis: F64) -> F64:
    """(3, 3) that turns rows p into axis x p by p @ M."""
    x, y, z = axis
    return np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])

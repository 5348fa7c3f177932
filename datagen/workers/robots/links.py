"""Bodies of a robot: a link with all links that are fixed to it, as convex parts with one mass."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.kinematics.tree import joint_motion
from datagen.workers.robots.gripper import Parts
from datagen.workers.robots.hulls import shape_parts
from datagen.workers.robots.robot_file import RobotSource
from datagen.workers.robots.urdf import Inertial, Joint, Link, Shape, UrdfTree, scaled_inertial


@dataclass(frozen=True, eq=False)
class LinkBody:
    """A link together with all links that are fixed to it. Links that only carry frames have no parts."""

    name: str
    inertial: Inertial | None
    parts_m: Parts  # link frame
    visuals: tuple[Shape, ...]  # visual meshes, link frame, unscaled
    scale: float
    drawn_m: Parts  # parts to draw where there are no visuals


Cluster = dict[str, tuple[Link, F64]]  # links that are fixed to the head, with their poses in its frame


def cluster_of(
    tree: UrdfTree, head: str, stops: Iterable[str], held: Mapping[str, float], T_head: F64 | None = None
) -> Cluster:
    """The head and all links below it up to the joints `stops`. Other joints stay where `held` says, or at 0.

    Where 0 lies outside a joint's range it stays at the nearer end. `T_head` is the head's pose in the frame
    of the cluster.
    """
    stops = set(stops)
    found: Cluster = {head: (tree.link(head), np.eye(4) if T_head is None else T_head)}
    waiting = [head]
    while waiting:
        parent = waiting.pop()
        for joint in tree.children(parent):
            if joint.name in stops:
                continue
            T = found[parent][1] @ joint.T_parent_child
            position = position_of(tree, joint, held)
            if position:
                T = T @ motion(joint, position)
            found[joint.child] = (tree.link(joint.child), T)
            waiting.append(joint.child)
    return found


def position_of(tree: UrdfTree, joint: Joint, held: Mapping[str, float]) -> float:
    """Where a joint stays that no plan moves."""
    driver, ratio, offset = tree.driver(joint)
    low, high = (driver.lower, driver.upper) if driver.lower <= driver.upper else (0.0, 0.0)
    return ratio * held.get(driver.name, min(max(0.0, low), high)) + offset


def motion(joint: Joint, position: float) -> F64:
    """(4, 4) by which a joint at a position, radians or metres, moves its child."""
    if joint.kind not in ("revolute", "continuous", "prismatic"):
        return np.eye(4)
    return joint_motion(joint.axis, joint.kind == "prismatic", np.array([position]))[0]


def body_of(
    name: str, cluster: Cluster, scale: float = 1.0, cuts_m: Mapping[str, tuple[float, ...]] | None = None
) -> LinkBody:
    """One body of a cluster's links, scaled."""
    parts: list[F32] = []
    visuals: list[Shape] = []
    for link, T in cluster.values():
        for shape in link.collisions:
            parts += shape_parts(_placed(shape, T), scale, (cuts_m or {}).get(link.name, ()))
        visuals += (_placed(shape, T) for shape in link.visuals)
    inertial = _combined([(link.inertial, T) for link, T in cluster.values() if link.inertial])
    if inertial is not None:
        inertial = scaled_inertial(inertial, scale)
    # Visual meshes are read from glTF alone; hulls replace those of other formats.
    if any(shape.mesh is None or shape.mesh.suffix != ".glb" for shape in visuals):
        visuals = []
    drawn = () if visuals else tuple(parts)
    return LinkBody(name, inertial, tuple(parts), tuple(visuals), scale, drawn)


def refuse_followers(source: RobotSource, tree: UrdfTree, field: str, names: Iterable[str]) -> None:
    """Raise InputError for a joint that is missing, or that mimics another, which decides."""
    for name in names:
        if (driver := tree.driver(tree.joint(name))[0].name) != name:
            raise source.wrong(field, f"joint {name} mimics {driver}", f"Name {driver}")


def without_shapes(tree: UrdfTree, names: Iterable[str]) -> UrdfTree:
    """The tree without the shapes of some links. InputError for a link that is not there."""
    bare = {name: replace(tree.link(name), collisions=(), visuals=()) for name in names}
    return replace(tree, links={**tree.links, **bare})


def scaled_pose(T: F64, scale: float) -> F64:
    """A pose (4, 4) with its translation scaled."""
    out = T.copy()
    out[:3, 3] *= scale
    return out


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

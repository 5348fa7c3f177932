"""Robots: an arm on a mount with a gripper, its inverse kinematics and its self-collision."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import pinocchio
from scipy.linalg import lapack
from scipy.spatial import ConvexHull

from datagen.schemas.identity import digest_of
from datagen.workers.geometry.mesh import F32, F64, Mesh, concatenate
from datagen.workers.geometry.transforms import inverse
from datagen.workers.houses.glb import read_glb
from datagen.workers.robots.assembly import Assembly, LinkBody, assemble
from datagen.workers.robots.description import Gripper, HandDescription, Parts, RobotDescription
from datagen.workers.robots.hulls import hull_faces, polyhedron

# Their binary modules have no types.
pin: Any = pinocchio
_lapack: Any = lapack
_GREY = 190
_ROUNDING_M = 0.001  # far more than the rounding errors of lengths and tolerances
_read_visual = lru_cache(maxsize=64)(read_glb)
POSITION_TOLERANCE_M = 0.0005
ANGLE_TOLERANCE_RAD = float(np.radians(0.5))
_MAX_STEPS = 40
_LONGEST_STEP_RAD = 1.0  # any joint
_DAMPING = 1e-4
_DAMPING_PER_ERROR = 0.003
# Fails when the best error has not fallen to this share within this number of steps.
_PATIENCE, _PROGRESS = 8, 0.7
# Configurations in which pairs of links are checked, and the share of them in which a pair may touch.
_SAMPLES = 300
_MOST = 0.5


class Robot:
    """A robot at one mount height, moved by pinocchio. A joints move the arm; L links carry its shape.

    Base frame: the arm's mount, at (x, y, base_height_m) in the world, z up, x to the front. Equal
    arguments give equal numbers on every machine of one platform.
    """

    def __init__(self, description: RobotDescription, reach_m: float | None, base_height_m: float) -> None:
        lift = description.lift
        lift_m = base_height_m - lift.mount_at_zero_m if lift else 0.0
        assembly = assemble(description, reach_m, lift_m)
        self.name = description.name  # as the registry and the specification name it
        # Largest distance from the first joint that moves the TCP to the TCP.
        self.reach_m: float = assembly.reach_m if reach_m is None else reach_m
        self.scale = assembly.scale
        self.base_height_m = base_height_m
        self.base_radius_m = description.limits.base_radius_m  # None stands on a pedestal
        self.gripper = _gripper(description.hand, assembly)
        self._tcp_wrist_m: F64 = inverse(assembly.palm.T_parent_child @ assembly.T_palm_tcp)[:3, 3]
        slack_m = POSITION_TOLERANCE_M + ANGLE_TOLERANCE_RAD * float(np.linalg.norm(self._tcp_wrist_m))
        self._wrist_reach_m = assembly.wrist_reach_m + slack_m + _ROUNDING_M
        self.T_base_root: F64 = inverse(assembly.T_root_mount)  # (4, 4), pose of the URDF's root link
        # (3,), base frame: the point that reach_m is measured from; no TCP is ever farther.
        self.shoulder_m: F64 = (self.T_base_root @ assembly.arm[0].T_parent_child)[:3, 3]
        self.joint_names = tuple(joint.name for joint in assembly.arm)  # (A,) from the base on
        self.finger_joint_names = (assembly.fingers[0].name, assembly.fingers[1].name)
        self.q_lower_rad: F64 = np.array([joint.lower for joint in assembly.arm])  # (A,)
        self.q_upper_rad: F64 = np.array([joint.upper for joint in assembly.arm])  # (A,)
        self.speed_limit_radps: F64 = np.array([joint.speed for joint in assembly.arm])  # (A,)
        self.homes_rad: F64 = np.array(description.homes_rad)  # (H, A), tucked, free of self-collision
        self.stiffness = description.stiffness  # drives of the arm, as ManiSkill's agent has them
        self.damping = description.damping
        self.force_limit_n = description.force_limit_n
        self.link_names = tuple(body.name for body in assembly.bodies)  # (L,)
        # (L,) convex parts in link frames, fingers fully open.
        self.link_parts_m: tuple[Parts, ...] = tuple(body.parts_m for body in assembly.bodies)
        self.assembly = assembly
        self._model = _model_of(assembly, self.T_base_root)
        self._data = self._model.createData()
        self._tcp = self._model.getFrameId("tcp")
        first = self._tcp - len(self.link_names)
        self._frames = range(first, self._tcp)
        frames = self._model.frames
        joints = [frames[f].parentJoint for f in self._frames]
        placements = [frames[f].placement.homogeneous for f in self._frames]
        # One hull a finger is close enough and four times as fast as its boxes.
        parts = [*self.link_parts_m[:-2], *((_joint_hull(p),) for p in self.link_parts_m[-2:])]
        self._self_collision = SelfCollision(self._model, parts, joints, placements)
        self.self_pairs = self._self_collision.pairs  # pairs of links that must not touch

    def at_height(self, base_height_m: float) -> Robot:
        """The same arm on a pedestal of another height; both share all other data."""
        other = copy.copy(self)
        other.base_height_m = base_height_m
        return other

    def T_base_link(self, q_rad: F64) -> F64:
        """Poses (L, 4, 4) of the links at the joints (A,)."""
        pin.framesForwardKinematics(self._model, self._data, q_rad)
        placements = self._data.oMf
        T = np.empty((len(self._frames), 4, 4))
        for k, frame in enumerate(self._frames):
            T[k] = placements[frame].homogeneous
        return T

    def T_base_tcp(self, q_rad: F64) -> F64:
        """Pose (4, 4) of the gripper's TCP at the joints (A,)."""
        pin.forwardKinematics(self._model, self._data, q_rad)
        return pin.updateFramePlacement(self._model, self._data, self._tcp).homogeneous

    def ik(self, T_base_tcp: F64, q_seed_rad: F64) -> F64 | None:
        """Joints (A,) within the limits that put the TCP at the pose (0.5 mm, 0.5 degrees), or None."""
        return solve(self._model, self._data, self._tcp, T_base_tcp, q_seed_rad)

    def is_wrist_within_reach(self, T_base_tcp: F64, beyond_m: float = 0.0) -> npt.NDArray[np.bool_]:
        """Whether the last joint is at most `beyond_m` beyond its reach at each TCP pose (N, 4, 4); (N,).

        `ik` fails at all poses where it is beyond its reach.
        """
        wrist_m = T_base_tcp[:, :3, :3] @ self._tcp_wrist_m + T_base_tcp[:, :3, 3]
        return np.linalg.norm(wrist_m - self.shoulder_m, axis=1) <= self._wrist_reach_m + beyond_m

    def collides_itself(self, q_rad: F64) -> bool:
        """Whether any of `self_pairs` touch at the joints (A,)."""
        return self._self_collision.touches(q_rad)

    def link_meshes(self) -> tuple[Mesh, ...]:
        """Visual meshes (L,), link frames."""
        return tuple(_mesh_of(body) for body in self.assembly.bodies)


def _model_of(assembly: Assembly, T_base_root: F64) -> Any:
    """A model with the arm's joints, a frame for every body, fingers open, and one for the TCP."""
    model = pin.Model()
    at = 0
    placements = [T_base_root]
    parents = [0]
    for joint in assembly.arm:
        T = (T_base_root if at == 0 else np.eye(4)) @ joint.T_parent_child
        kind = (
            pin.JointModelRZ()
            if np.array_equal(joint.axis, (0, 0, 1))
            else pin.JointModelRevoluteUnaligned(joint.axis)
        )
        limits = (np.array([v]) for v in (joint.effort, joint.speed, joint.lower, joint.upper))
        at = model.addJoint(at, kind, pin.SE3(T), joint.name, *limits)
        placements.append(np.eye(4))
        parents.append(at)
    T_palm = assembly.palm.T_parent_child
    placements.append(T_palm)
    for joint in assembly.fingers:
        slide = np.eye(4)
        slide[:3, 3] = joint.axis * joint.upper
        placements.append(T_palm @ joint.T_parent_child @ slide)
    placements.append(T_palm @ assembly.T_palm_tcp)
    parents += [at] * 4
    names = [*(body.name for body in assembly.bodies), "tcp"]
    for name, joint_id, T in zip(names, parents, placements, strict=True):
        model.addFrame(pin.Frame(name, joint_id, 0, pin.SE3(T), pin.FrameType.OP_FRAME))
    return model


def _gripper(hand: HandDescription, assembly: Assembly) -> Gripper:
    from_palm = inverse(assembly.T_palm_tcp)
    palm, *fingers = assembly.bodies[-3:]
    palm_parts = tuple(_moved(part, from_palm) for part in palm.parts_m)
    left, right = (
        tuple(_moved(part, from_palm @ joint.T_parent_child) for part in body.parts_m)
        for body, joint in zip(fingers, assembly.fingers, strict=True)
    )
    opening = 2 * assembly.fingers[0].upper
    depth = -max(float(part[:, 2].max()) for part in palm_parts)
    parts = [part.tolist() for part in (*palm_parts, *left, *right)]
    digest = digest_of([hand.name, opening, list(hand.pad_size_m), depth, parts])
    return Gripper(hand.name, digest, opening, hand.pad_size_m, depth, palm_parts, (left, right))


def _moved(part: F32, T: F64) -> F32:
    return (part.astype(np.float64) @ T[:3, :3].T + T[:3, 3]).astype(np.float32)


def _joint_hull(parts_m: Parts) -> F32:
    """Corners (V, 3) of the one hull around several parts."""
    points = np.concatenate(parts_m)
    return points[np.sort(ConvexHull(points).vertices)]


def _mesh_of(body: LinkBody) -> Mesh:
    """A body's visual meshes, else its hulls, in the link frame. Raises InputError naming a broken file."""
    meshes: list[Mesh] = []
    for shape in body.visuals:
        assert shape.mesh is not None
        T = np.diag([body.scale] * 3 + [1.0]) @ shape.T_link_shape @ np.diag([*shape.scale, 1.0])
        meshes.append(_read_visual(shape.mesh).transformed(T))
    return concatenate([*meshes, *(_plain(part) for part in body.drawn_m)])


def _plain(corners_m: F32) -> Mesh:
    faces, _ = hull_faces(corners_m)
    return Mesh(corners_m, faces, np.full((len(faces), 3), _GREY, np.uint8))


def solve(model: Any, data: Any, frame: int, T_base_tcp: F64, q_seed_rad: F64) -> F64 | None:
    """Joints (A,) within the model's limits that put the frame at the pose (4, 4), or None.

    Levenberg-Marquardt with damping that grows with the squared error (Sugihara 2011), on the pose error
    as a twist in the frame itself; a joint at its limit stays there while the step pushes it out.
    """
    low, high = model.lowerPositionLimit, model.upperPositionLimit
    goal = pin.SE3(T_base_tcp)
    q = np.minimum(np.maximum(q_seed_rad, low), high)
    best, best_at = np.inf, 0
    for step in range(_MAX_STEPS):
        pin.computeJointJacobians(model, data, q)
        here = pin.updateFramePlacement(model, data, frame)
        error = pin.log6(here.actInv(goal)).vector
        # Plain floats and ndarray.dot: half of the time would go into the wrappers around them.
        x, y, z, a, b, c = error.tolist()
        distance, angle = x * x + y * y + z * z, a * a + b * b + c * c
        if distance < POSITION_TOLERANCE_M**2 and angle < ANGLE_TOLERANCE_RAD**2:
            return q
        squared = distance + angle
        if squared < _PROGRESS**2 * best:
            best, best_at = squared, step
        elif step - best_at >= _PATIENCE:
            return None
        J = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL)
        H = J.dot(J.T)
        H.flat[::7] += _DAMPING + _DAMPING_PER_ERROR * squared
        dq = J.T.dot(_lapack.dposv(H, error)[1])
        longest = max(map(abs, dq.tolist()))
        if longest > _LONGEST_STEP_RAD:
            dq *= _LONGEST_STEP_RAD / longest
        q = np.minimum(np.maximum(q + dq, low), high)
    return None


class SelfCollision:
    """Narrow-phase checks of pairs of bodies, each made of convex parts fixed to a joint.

    Bodies that are fixed to one another and bodies on both sides of one joint may always touch. Other pairs
    that touch in most of 300 random configurations (fixed seed) are left out too: their coarse hulls overlap.
    """

    def __init__(
        self,
        model: Any,
        parts_m: Sequence[Parts],  # one entry a body, body frame
        joint: Sequence[int],  # the model's joint that each body is fixed to
        T_joint_body: Sequence[F64],
    ) -> None:
        self._model, self._data = model, model.createData()
        self._geometry = pin.GeometryModel()
        body_of: list[int] = []
        for b, parts in enumerate(parts_m):
            placement = pin.SE3(T_joint_body[b])
            for part in parts:
                name = f"{b}.{len(body_of)}"
                shape = pin.GeometryObject(name, joint[b], placement, polyhedron(part))
                self._geometry.addGeometryObject(shape)
                body_of.append(b)
        free = {
            (a, b)
            for a in range(len(parts_m))
            for b in range(a + 1, len(parts_m))
            if joint[a] != joint[b] and model.parents[joint[b]] != joint[a]
        }
        self._keep(free, body_of)
        self.pairs = tuple(sorted(free - self._touching_often(body_of)))
        self._keep(set(self.pairs), body_of)
        self._results = self._geometry.createData()

    def _keep(self, pairs: set[tuple[int, int]], body_of: list[int]) -> None:
        self._geometry.removeAllCollisionPairs()
        for i in range(len(body_of)):
            for j in range(i + 1, len(body_of)):
                if (body_of[i], body_of[j]) in pairs:
                    self._geometry.addCollisionPair(pin.CollisionPair(i, j))

    def _touching_often(self, body_of: list[int]) -> set[tuple[int, int]]:
        results = self._geometry.createData()
        rng = np.random.Generator(np.random.PCG64(0))
        low, high = self._model.lowerPositionLimit, self._model.upperPositionLimit
        pairs = [(body_of[p.first], body_of[p.second]) for p in self._geometry.collisionPairs]
        touched: dict[tuple[int, int], int] = {}
        for left, q in zip(
            reversed(range(_SAMPLES)), rng.uniform(low, high, (_SAMPLES, len(low))), strict=True
        ):
            pin.computeCollisions(self._model, self._data, self._geometry, results, q, False)
            found = zip(pairs, results.collisionResults, strict=True)
            for pair in {pair for pair, result in found if result.isCollision()}:
                touched[pair] = touched.get(pair, 0) + 1
            # Stop when the remaining samples cannot change the result of any pair.
            most = _MOST * _SAMPLES
            if left <= most and all(not most - left < count <= most for count in touched.values()):
                break
        return {pair for pair, count in touched.items() if count > _MOST * _SAMPLES}

    def touches(self, q_rad: F64) -> bool:
        """Whether any of `pairs` touch at the joints (A,)."""
        return bool(
            pin.computeCollisions(self._model, self._data, self._geometry, self._results, q_rad, True)
        )

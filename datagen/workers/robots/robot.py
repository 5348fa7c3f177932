"""Robots: an arm on a mount with a gripper, its inverse kinematics and its self-collision."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from scipy.spatial import ConvexHull

from datagen.schemas.errors import InputError
from datagen.workers.geometry.mesh import BOX_BITS, F32, F64, Mesh, concatenate
from datagen.workers.geometry.transforms import inverse
from datagen.workers.houses.glb import read_glb
from datagen.workers.kinematics import contacts
from datagen.workers.kinematics.compiler import in_memory
from datagen.workers.kinematics.inverse import TreePoses
from datagen.workers.kinematics.tree import Coordinates, Ints, KinematicTree, frame_poses
from datagen.workers.robots.arm_chain import TURN
from datagen.workers.robots.assembly import assemble
from datagen.workers.robots.gripper import Parts
from datagen.workers.robots.hulls import hull_faces
from datagen.workers.robots.links import LinkBody
from datagen.workers.robots.robot_file import RobotSource

_GREY = 190
_read_visual = lru_cache(maxsize=64)(read_glb)


class Robot:
    """A robot at one mount height. A coordinates move the arm; L links carry its shape.

    Base frame: the arm's mount, at (x, y, base_height_m) in the world, z up, x to the front. Coordinates are
    radians, and metres where joints slide. Equal arguments give equal numbers on every machine of one
    platform.
    """

    def __init__(self, source: RobotSource, reach_m: float | None = None) -> None:
        assembly = assemble(source, reach_m)
        hand, base, chain = assembly.hand, assembly.base, assembly.chain
        self.source = source
        self.name = source.name  # as the registry and the specification name it
        # Largest distance from the shoulder to the TCP.
        self.reach_m: float = assembly.reach_m if reach_m is None else reach_m
        self.scale = assembly.scale
        self.base_height_m = base.height_m or 0.0
        self.base = base
        self.base_radius_m = base.radius_m  # None stands on a pedestal
        self.presents = source.keys.base.presents  # how the base stands to the target
        self.gripper = hand.gripper
        self.T_base_root: F64 = inverse(base.T_root_mount)  # (4, 4), pose of the URDF's root link
        # (3,), base frame: the point that reach_m is measured from; no TCP is ever farther.
        self.shoulder_m: F64 = assembly.shoulder_m
        self.joint_names = chain.coordinates  # (A,) of the coordinates, from the base on
        self.slides = chain.slides  # (A,)
        self.q_lower_rad: F64 = chain.lower  # (A,)
        self.q_upper_rad: F64 = chain.upper  # (A,)
        self.speed_limit_radps: F64 = chain.speed  # (A,)
        self.drive = source.keys.drive
        self.link_names = tuple(body.name for body in assembly.bodies)  # (L,)
        # (L,) convex parts in link frames, fingers fully open.
        self.link_parts_m: tuple[Parts, ...] = tuple(body.parts_m for body in assembly.bodies)
        self.first_hand_link = len(assembly.arm) + 1  # the palm; the fingers follow
        self.assembly = assembly
        # Whether each link (L,) stands on the floor: what carries the arm.
        self.is_base = np.arange(len(assembly.bodies)) <= int(assembly.arm[0].name == TURN)
        self.tree: KinematicTree = assembly.tree()  # the only source of kinematics
        self.coordinates = Coordinates.of(self.tree)
        self._poses = TreePoses(self.tree)
        # One hull a finger is close enough, and faster than its boxes.
        fingers = self.link_parts_m[self.first_hand_link + 1 :]
        parts = [
            *self.link_parts_m[: self.first_hand_link + 1],
            *((_joint_hull(p),) if p else () for p in fingers),
        ]
        deck = None if base.deck_m is None else int(chain.turns)
        self.self_collision = SelfCollision(self.tree, self._poses, parts, deck)
        self.self_pairs = self.self_collision.pairs  # pairs of links that must not touch
        self.homes_rad: F64 = self._tucked()  # (H, A), tucked, free of self-collision

    def _tucked(self) -> F64:
        """The poses of the file, else of a search. InputError where one touches the robot itself."""
        given, wrong = self.source.keys.arm.tucked, self.source.wrong
        if given:
            homes = np.array(given)
            if homes.shape[1] != len(self.joint_names):
                names = ", ".join(self.joint_names)
                raise wrong(
                    "arm.tucked",
                    f"has rows of {homes.shape[1]} numbers",
                    f"Give {len(self.joint_names)}: {names}",
                )
            inside = (homes >= self.q_lower_rad) & (homes <= self.q_upper_rad)
            for row, is_inside in zip(homes, inside, strict=True):
                if not is_inside.all():
                    raise wrong(
                        "arm.tucked", f"{self.joint_names[int(is_inside.argmin())]} is outside its range"
                    )
                if self.scale == 1.0 and self.collides_itself(row):
                    raise wrong(
                        "arm.tucked",
                        f"the pose {row.tolist()} touches the robot itself",
                        "Correct or omit it",
                    )
            return homes
        floor_m = -self.base_height_m if self.base_radius_m is not None else 0.0
        homes = tucked_poses(
            self.tree,
            self.link_parts_m,
            self.base_radius_m or 0.2,
            floor_m,
            lambda q: not self.collides_itself(q),
        )
        if len(homes) == 0:
            fix = "Give arm.tucked, or leave out links whose hulls overlap with arm.ignore"
            raise wrong("arm", "no pose is free of self-collision", fix)
        return homes

    def at_height(self, base_height_m: float) -> Robot:
        """The same arm on a pedestal of another height; both share all other data."""
        other = copy.copy(self)
        other.base_height_m = base_height_m
        return other

    def T_base_link(self, q_rad: F64) -> F64:
        """Poses (L, 4, 4) of the links at the joints (A,)."""
        T = np.tile(np.eye(4), (len(self.link_names), 1, 1))
        T[:, :3] = self._poses(q_rad)[:-1]
        return T

    def T_base_tcp(self, q_rad: F64) -> F64:
        """Pose (4, 4) of the gripper's TCP at the joints (A,)."""
        return np.concatenate([self._poses(q_rad)[-1], [[0.0, 0.0, 0.0, 1.0]]])

    def ik(self, T_base_tcp: F64, q_seed_rad: F64) -> F64 | None:
        """Joints (A,) within the limits that put the TCP at the pose (0.5 mm, 0.5 degrees), or None."""
        return self._poses.solve(T_base_tcp, q_seed_rad)

    def collides_itself(self, q_rad: F64) -> bool:
        """Whether any of `self_pairs` touch at the joints (A,)."""
        return self.self_collision.touches(q_rad)

    def link_meshes(self) -> tuple[Mesh, ...]:
        """Visual meshes (L,), link frames."""
        return tuple(_mesh_of(body) for body in self.assembly.bodies)


def _joint_hull(parts_m: Parts) -> F32:
    """Corners (V, 3) of the one hull around several parts."""
    points = np.concatenate(parts_m)
    return points[np.sort(ConvexHull(points).vertices)]


def _mesh_of(body: LinkBody) -> Mesh:
    """A body's visual meshes, else its hulls, in the link frame."""
    meshes: list[Mesh] = []
    try:
        for shape in body.visuals:
            assert shape.mesh is not None
            T = np.diag([body.scale] * 3 + [1.0]) @ shape.T_link_shape @ np.diag([*shape.scale, 1.0])
            meshes.append(_read_visual(shape.mesh).transformed(T))
    except InputError:  # what cannot be read is drawn as its hulls
        return concatenate([*map(_plain, body.parts_m)])
    return concatenate([*meshes, *map(_plain, body.drawn_m)])


def _plain(corners_m: F32) -> Mesh:
    faces, _ = hull_faces(corners_m)
    return Mesh(corners_m, faces, np.full((len(faces), 3), _GREY, np.uint8))


# Configurations in which pairs of links are checked, and the share of them in which a pair may touch.
_SAMPLES = 300
_MOST = 0.5


class SelfCollision:
    """Exact checks of pairs of links, each made of convex parts fixed to a frame of the tree.

    Links that are fixed to one another, links on both sides of one joint and the segments of one telescope
    may always touch. Other pairs that touch in most of 300 random configurations (fixed seed) are left out
    too: their coarse hulls overlap. The last part of the link `deck` is a base as it was given and exact:
    it does not count there.
    """

    def __init__(
        self,
        tree: KinematicTree,
        poses: TreePoses,
        parts_m: Sequence[Sequence[F32 | F64]],
        deck: int | None = None,
    ) -> None:
        self.parts = contacts.parts_of(parts_m)
        joint = tree.frame_joint.tolist()
        rows = [
            (a, b)
            for a in range(len(parts_m))
            for b in range(a + 1, len(parts_m))
            if joint[a] != joint[b] and not _is_telescope(tree, joint[a], joint[b])
        ]
        self._compiled, self._poses = in_memory(self.parts), poses
        self._scratch = contacts.own_scratch(self._compiled)
        pairs = _part_pairs(self.parts, rows)
        link = self.parts.owner[pairs]  # (K, 2)
        rng, touches = np.random.Generator(np.random.PCG64(0)), np.empty((_SAMPLES, len(pairs)), np.bool_)
        T = np.stack([poses(q) for q in rng.uniform(tree.lower, tree.upper, (_SAMPLES, len(tree.lower)))])
        contacts.touching_pairs(self._compiled, pairs, T, self._scratch, touches)
        if deck is not None:
            touches[:, (pairs == np.flatnonzero(self.parts.owner == deck)[-1]).any(axis=1)] = False
        count = {pair: int(touches[:, (link == pair).all(axis=1)].any(axis=1).sum()) for pair in rows}
        self.pairs = tuple(pair for pair in rows if count[pair] <= _MOST * _SAMPLES)  # of links
        self.part_pairs = _part_pairs(self.parts, self.pairs)  # (K, 2)
        self._axes = np.zeros((len(self.part_pairs), 3))

    def touches(self, q_rad: F64) -> bool:
        """Whether any of `pairs` touch at the coordinates (A,)."""
        self._axes[:] = 0.0  # no answer depends on earlier ones
        return contacts.hits_itself(
            self._compiled, self.part_pairs, self._poses(q_rad), self._axes, self._scratch
        )


def _is_telescope(tree: KinematicTree, upper: int, lower: int) -> bool:
    """Whether one joint lies between two joints' bodies, or several that slide with one coordinate."""
    between = list[int]()
    while lower > upper:
        between.append(lower)
        lower = int(tree.parent[lower])
    is_one = len(set(tree.coordinate[between].tolist())) == 1 and bool(tree.slides[between].all())
    return lower == upper and (len(between) == 1 or is_one)


def _part_pairs(parts: contacts.Parts, links: Sequence[tuple[int, int]]) -> Ints:
    of = [np.flatnonzero(parts.owner == link) for link in range(int(parts.owner.max(initial=-1)) + 1)]
    rows = [(i, j) for a, b in links if b < len(of) for i in of[a].tolist() for j in of[b].tolist()]
    return np.array(rows, np.int64).reshape(-1, 2)


_LOOKED_AT, _BEST, _STEPS = 6000, 400, 6
_POSES, _LEAST_APART_RAD = 8, 0.7
_STEP = 0.1  # first step of the descent, as a share of the range
_FRONT = 0.5  # weight of what stands out to the front, where tables are


def tucked_poses(
    tree: KinematicTree,
    parts_m: Sequence[Parts],
    radius_m: float,
    floor_m: float,
    is_free: Callable[[F64], bool],
) -> F64:
    """Poses (H, A), the most compact first; empty where none of those looked at is free.

    Compact: little stands out of a circle of `radius_m` around the mount, less to the front; nothing comes
    within 10 cm of the floor at height `floor_m` in the base frame.
    """
    rng = np.random.Generator(np.random.PCG64(0))
    rows, corners = list[int](), list[F64]()
    for k, parts in enumerate(parts_m):
        if parts and tree.frame_joint[k] >= 0:
            points = np.concatenate(parts).astype(np.float64)
            low, high = points.min(axis=0), points.max(axis=0)
            corners.append(np.where(BOX_BITS, high, low))
            rows.append(k)
    boxes = np.array(corners)

    def cost(q: F64) -> F64:
        T = frame_poses(tree, q)[:, rows]
        points = np.einsum("mbij,bcj->mbci", T[..., :3, :3], boxes) + T[..., None, :3, 3]
        points = points.reshape(len(q), -1, 3)
        out = np.maximum(np.hypot(points[..., 0], points[..., 1]) - radius_m, 0.0)
        ahead = np.maximum(points[..., 0] - radius_m, 0.0)
        low = np.maximum(floor_m + 0.1 - points[..., 2], 0.0)
        return out.max(axis=1) + 0.3 * out.mean(axis=1) + _FRONT * ahead.max(axis=1) + 10 * low.max(axis=1)

    # Away from the limits, where paths begin with less freedom.
    low = tree.lower + 0.03 * (tree.upper - tree.lower)
    high = tree.upper - 0.03 * (tree.upper - tree.lower)
    q = rng.uniform(low, high, (_LOOKED_AT, len(low)))
    q = q[np.argsort(cost(q), kind="stable")[:_BEST]]
    found, step = cost(q), _STEP
    for _ in range(_STEPS):
        for _ in range(3):
            tried = np.clip(q + step * (high - low) * rng.standard_normal(q.shape), low, high)
            other = cost(tried)
            better = other < found
            q[better], found[better] = tried[better], other[better]
        step /= 1.5
    kept = list[F64]()
    for row in np.argsort(found, kind="stable"):
        apart = min((float(np.abs(q[row] - other).max()) for other in kept), default=np.inf)
        if apart > _LEAST_APART_RAD and is_free(q[row]):
            kept.append(q[row])
            if len(kept) == _POSES:
                break
    return np.array(kept).reshape(-1, len(low))

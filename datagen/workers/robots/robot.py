"""Robots: an arm on a mount with a gripper, its inverse kinematics and its self-collision."""

from __future__ import annotations

import copy
from functools import lru_cache

import numpy as np
from scipy.spatial import ConvexHull

from datagen.schemas.errors import InputError
from datagen.workers.geometry.mesh import F32, F64, Mesh, concatenate
from datagen.workers.geometry.transforms import inverse
from datagen.workers.houses.glb import read_glb
from datagen.workers.kinematics.inverse import TreePoses
from datagen.workers.kinematics.tree import Coordinates, KinematicTree
from datagen.workers.robots.arm_chain import TURN
from datagen.workers.robots.assembly import assemble
from datagen.workers.robots.gripper import Parts
from datagen.workers.robots.hulls import hull_faces
from datagen.workers.robots.links import LinkBody
from datagen.workers.robots.robot_file import RobotSource
from datagen.workers.robots.self_collision import SelfCollision
from datagen.workers.robots.tucked import tucked_poses

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
        self.self_collision = SelfCollision(self.tree, self._poses, parts)
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

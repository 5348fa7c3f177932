"""A robot as ray meshes: its links at given joints, the fingers, the pedestal."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from datagen.workers.furniture.solids import frustum, join
from datagen.workers.geometry.mesh import F64, I32, Mesh
from datagen.workers.geometry.transforms import inverse
from datagen.workers.rendering.embree import RayMesh, ray_mesh
from datagen.workers.robots.robot import Robot

_PEDESTAL_RGB, _PEDESTAL_SIDES = (196, 205, 216), 24
_FINGER_RGB = (0, 185, 200)  # rare among objects, so that the fingers are visible


@dataclass(frozen=True, eq=False)
class RobotBodies:
    """B bodies: the links that have a mesh, and the pedestal of robots that have one."""

    robot: Robot
    rays: tuple[RayMesh, ...]  # (B,)
    radii_m: F64  # (B,), around the bodies' origins
    link: I32  # (B,), row of the link; -1 for the pedestal
    finger: I32  # (B,), row among the gripper's bodies of those that its fingers are, else 0

    def poses(self, T_world_base: F64, q_rad: F64, opening_m: float) -> F64:
        """Poses (B, 4, 4) in the world for joints (A,) and the opening between the pads (m)."""
        T_base_link = np.concatenate([self.robot.T_base_link(q_rad), np.eye(4)[None]])
        T_base_tcp = self.robot.T_base_tcp(q_rad)
        out = T_world_base @ T_base_link[self.link]
        # Links are posed with the hand fully open.
        here, open_wide = self.robot.gripper.body_poses(
            np.array([opening_m, self.robot.gripper.max_opening_m])
        )
        for k in self.hand:
            moved = T_base_tcp @ here[self.finger[k]] @ inverse(T_base_tcp @ open_wide[self.finger[k]])
            out[k] = T_world_base @ moved @ T_base_link[self.link[k]]
        return out

    @property
    def hand(self) -> list[int]:
        """Rows of the finger bodies."""
        return np.flatnonzero(self.finger).tolist()


@lru_cache(maxsize=1)  # trials of one scene mostly have one robot
def robot_bodies(robot: Robot, pedestal_radius_m: float) -> RobotBodies:
    """The robot's bodies, with a pedestal for robots without a base of their own."""
    palm = robot.first_hand_link
    bodies = [
        (_coloured(mesh) if k > palm else mesh, k, max(k - palm, 0))
        for k, mesh in enumerate(robot.link_meshes())
        if len(mesh.faces)
    ]
    if robot.base_radius_m is None:
        r, height_m = (pedestal_radius_m, pedestal_radius_m), robot.base_height_m
        column = frustum((-height_m, 0.0), r, r, _PEDESTAL_RGB, _PEDESTAL_SIDES)
        bodies.append((join([column])[0], -1, 0))
    meshes, links, fingers = zip(*bodies, strict=True)
    radii_m = np.array([float(np.linalg.norm(m.vertices_m, axis=1).max()) for m in meshes])
    rays = tuple(ray_mesh(mesh) for mesh in meshes)
    return RobotBodies(robot, rays, radii_m, np.array(links, np.int32), np.array(fingers, np.int32))


def _coloured(mesh: Mesh) -> Mesh:
    rgb = np.tile(np.array(_FINGER_RGB, np.uint8), (len(mesh.faces), 1))
    return Mesh(mesh.vertices_m, mesh.faces, rgb)

"""A robot as ray meshes: its links at given joints, the fingers, the pedestal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datagen.workers.furniture.solids import frustum, join
from datagen.workers.geometry.mesh import F64, I32, Mesh
from datagen.workers.geometry.transforms import inverse, translation
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
    finger_side: I32  # (B,), +1 and -1 for bodies that move with finger 0 and 1, else 0

    def poses(self, T_world_base: F64, q_rad: F64, opening_m: float) -> F64:
        """Poses (B, 4, 4) in the world for joints (A,) and the opening between the pads (m)."""
        T_base_link = np.concatenate([self.robot.T_base_link(q_rad), np.eye(4)[None]])
        T_base_tcp = self.robot.T_base_tcp(q_rad)
        out = T_world_base @ T_base_link[self.link]
        for k in self.hand:
            # Links are posed with the hand fully open; fingers slide along y of the TCP.
            slide_m = float(self.finger_side[k]) * (opening_m - self.robot.gripper.max_opening_m) / 2
            slide = T_base_tcp @ translation(0.0, slide_m, 0.0) @ inverse(T_base_tcp)
            out[k] = T_world_base @ slide @ T_base_link[self.link[k]]
        return out

    @property
    def hand(self) -> list[int]:
        """Rows of the finger bodies."""
        return np.flatnonzero(self.finger_side).tolist()


def robot_bodies(robot: Robot, pedestal_radius_m: float) -> RobotBodies:
    """The robot's bodies, with a pedestal for robots without a base of their own."""
    sides = dict(zip(robot.link_names[-2:], (1, -1), strict=True))
    bodies = [
        (_coloured(mesh) if name in sides else mesh, k, sides.get(name, 0))
        for k, (name, mesh) in enumerate(zip(robot.link_names, robot.link_meshes(), strict=True))
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

"""A robot drawn from its file: tucked, stretched, from above over its footprint and reach, and its hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from datagen.drawing.film import View, font_of, no_house
from datagen.drawing.posed_robot import RobotBodies, robot_bodies
from datagen.workers.geometry.mesh import BOX_BITS, F64, Mesh, transformed
from datagen.workers.geometry.transforms import inverse, translation
from datagen.workers.rendering.embree import RayMesh, RayScene, ray_mesh
from datagen.workers.robots.hulls import hull_faces
from datagen.workers.robots.robot import Robot

PEDESTAL_M, PEDESTAL_RADIUS_M = 0.6, 0.2  # drawn below robots that have no base
_SIZE_PX, _SHARPNESS, _TEXT_PX = (560, 520), 2, 26
_FLOOR, _BASE, _REACH, _BOX = (236, 238, 241), (255, 178, 102), (70, 120, 220), (210, 70, 70)
_RING, _RING_M, _THIN_M = 96, 0.012, 0.002


def draw_robot(robot: Robot, q_stretched: F64, out: Path) -> None:
    """Write a PNG of four views. Raises OSError."""
    bodies = robot_bodies(robot, PEDESTAL_RADIUS_M)
    height_m = robot.base_height_m if robot.base_radius_m is not None else PEDESTAL_M
    T_world_base, wide = translation(0.0, 0.0, height_m), robot.gripper.max_opening_m
    floor = [ray_mesh(mesh) for mesh in _floor(robot)]
    q_tucked, q_stretched = robot.homes_rad[0].copy(), q_stretched.copy()
    if robot.presents == "turns":
        q_tucked[0] = q_stretched[0] = 0.0  # as the footprint is drawn
    poses = [("tucked", q_tucked), ("stretched", q_stretched)]
    views: list[tuple[str, Image.Image]] = []
    for name, q in poses:
        T = bodies.poses(T_world_base, q, wide)
        points = _points(bodies, T)
        eye = points.mean(axis=0) + np.array([1.6, -1.9, 1.0]) * max(1.0, float(np.ptp(points, axis=0).max()))
        views.append((name, _picture(eye, points, [*floor, *bodies.rays], [*[np.eye(4)] * len(floor), *T])))
    T = bodies.poses(T_world_base, q_stretched, wide)
    points = np.vstack([_points(bodies, T), _ring(robot.reach_m + 0.05)])
    above = points.mean(axis=0) * (1, 1, 0) + (-0.001, 0.0, 6.0)
    stage = [*floor, *bodies.rays], [*[np.eye(4)] * len(floor), *T]
    views.append((f"from above: footprint, reach {robot.reach_m:.2f} m", _picture(above, points, *stage)))
    views.append((f"hand, closing on {50 * wide:.1f} cm", _hand(robot, bodies)))
    _write(views, out)


def _hand(robot: Robot, bodies: RobotBodies) -> Image.Image:
    """The hand half open with a box between its pads, seen across the closing direction."""
    gripper, q = robot.gripper, robot.homes_rad[0]
    width_m = gripper.max_opening_m / 2
    T_tcp_base = inverse(robot.T_base_tcp(q))
    T = bodies.poses(T_tcp_base, q, width_m)
    rows = [k for k, link in enumerate(bodies.link) if link >= robot.first_hand_link]
    depth_m = float(gripper.pad_depth_m(np.array([width_m]))[0])
    half_m = np.array([gripper.pad_size_m[0], width_m, gripper.pad_size_m[1]]) / 2
    corners_m = (BOX_BITS * 2.0 - 1) * half_m + (0.0, 0.0, depth_m)
    faces, _ = hull_faces(corners_m.astype(np.float32))
    box = Mesh(corners_m.astype(np.float32), faces, np.tile(np.array(_BOX, np.uint8), (len(faces), 1)))
    points = _points(bodies, T, rows)
    eye_m = points.mean(axis=0) + np.array([0.5, 0.1, 0.15])
    return _picture(eye_m, points, [ray_mesh(box), *(bodies.rays[k] for k in rows)], [np.eye(4), *T[rows]])


def _picture(eye_m: F64, points_m: F64, rays: list[RayMesh], T: list[F64]) -> Image.Image:
    view = View(eye_m, points_m, _SIZE_PX)
    radii_m = np.array([float(np.linalg.norm(r.mesh.vertices_m, axis=1).max()) for r in rays])
    return view.picture(RayScene(no_house(), rays, radii_m, np.stack(T)), _SHARPNESS)


def _points(bodies: RobotBodies, T: F64, rows: list[int] | None = None) -> F64:
    chosen = range(len(bodies.rays)) if rows is None else rows
    return np.concatenate([transformed(bodies.rays[k].mesh.vertices_m, T[k]) for k in chosen])


def _floor(robot: Robot) -> list[Mesh]:
    """The footprint and the circle of the reach, flat on the floor around the mount."""
    outline = robot.base.footprint_m
    radius_m = robot.base_radius_m or PEDESTAL_RADIUS_M
    corners = np.array(outline) if outline is not None else _ring(radius_m)[:, :2]
    return [_flat(corners, np.zeros_like(corners), _BASE), _flat(*_band(robot.reach_m), _REACH)]


def _band(radius_m: float) -> tuple[F64, F64]:
    ring = _ring(radius_m)[:, :2]
    return ring, ring * (1 - _RING_M / radius_m)


def _ring(radius_m: float) -> F64:
    angles = 2 * np.pi * np.arange(_RING) / _RING
    return radius_m * np.stack([np.cos(angles), np.sin(angles), np.zeros(_RING)], axis=1)


def _flat(outer: F64, inner: F64, rgb: tuple[int, int, int]) -> Mesh:
    """The band between two outlines (N, 2), seen from both sides."""
    n = len(outer)
    points = np.column_stack([np.concatenate([outer, inner]), np.full(2 * n, _THIN_M)]).astype(np.float32)
    a, b = np.arange(n), (np.arange(n) + 1) % n
    faces = np.concatenate([np.stack([a, b, n + a], axis=1), np.stack([b, n + b, n + a], axis=1)])
    both = np.concatenate([faces, faces[:, ::-1]]).astype(np.int32)
    return Mesh(points, both, np.tile(np.array(rgb, np.uint8), (len(both), 1)))


def _write(views: list[tuple[str, Image.Image]], out: Path) -> None:
    w, h = _SIZE_PX
    sheet = Image.new("RGB", (2 * w + 10, 2 * (h + _TEXT_PX + 10)), "white")
    draw, font = ImageDraw.Draw(sheet), font_of(18)
    for k, (name, image) in enumerate(views):
        x, y = (k % 2) * (w + 10), (k // 2) * (h + _TEXT_PX + 10)
        draw.text((x + 6, y + 4), name, fill="black", font=font)
        sheet.paste(image, (x, y + _TEXT_PX + 6))
    sheet.save(out)

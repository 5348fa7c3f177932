"""Successful grasps as outlines of the hand around the target, from above and from the side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize

from datagen.workers.furniture.solids import box, join
from datagen.workers.geometry.mesh import F32, F64, U8, Mesh
from datagen.workers.geometry.transforms import look_at
from datagen.workers.rendering import Camera, Frame
from datagen.workers.rendering.embree import RayScene, ray_mesh, render_rays
from datagen.workers.robots.description import Gripper
from datagen.workers.scenes.reconstruct import ReconstructedScene

_SAME_M, _SAME_RAD = 0.004, 0.06  # joint angles reach a grasp within 0.5 mm and 0.5 degrees
_FAR_M = 6.0  # far enough for a nearly parallel view
_HAND_M = 0.12  # room for hands around the target
_WRIST_M = 0.05  # drawn behind the palm, to show where the hand comes from
_SIZE_PX = 420
_SHEET_RGB = (214, 205, 190)


@dataclass(frozen=True, eq=False)
class UsedGrasps:
    """G different grasps, most frequent first."""

    T_target_tcp: F64  # (G, 4, 4)
    count: npt.NDArray[np.int64]  # (G,)


def used_grasps(T_target_tcp: F32) -> UsedGrasps:
    """The distinct grasps among N grasps (N, 4, 4), with their counts."""
    rest = np.asarray(T_target_tcp, np.float64)
    kept: list[F64] = []
    counts: list[int] = []
    while len(rest):
        near = np.linalg.norm(rest[:, :3, 3] - rest[0, :3, 3], axis=1) < _SAME_M
        # The trace of a relative rotation is 1 + 2 cos(angle).
        trace = np.einsum("nij,ij->n", rest[:, :3, :3], rest[0, :3, :3])
        same = near & (trace > 1 + 2 * np.cos(_SAME_RAD))
        same[0] = True
        kept.append(rest[0])
        counts.append(int(same.sum()))
        rest = rest[~same]
    order = np.argsort(-np.array(counts, np.int64), kind="stable")
    return UsedGrasps(np.array(kept).reshape(-1, 4, 4)[order], np.array(counts, np.int64)[order])


def hand_outline(gripper: Gripper) -> F64:
    """The open hand as line segments (S, 2, 3) in its TCP frame: wrist, palm and two fingers."""
    half, palm = gripper.max_opening_m / 2, -gripper.palm_depth_m
    tip = gripper.pad_size_m[1] / 2
    return np.array(
        [
            [[0, 0, palm - _WRIST_M], [0, 0, palm]],
            [[0, -half, palm], [0, half, palm]],
            [[0, half, palm], [0, half, tip]],
            [[0, -half, palm], [0, -half, tip]],
        ],
        np.float64,
    )


def draw_grasps(
    views: tuple[Axes, Axes], recalled: ReconstructedScene, support: Mesh, gripper: Gripper, used: UsedGrasps
) -> ScalarMappable | None:
    """Draw the grasps from above and from the observer's side; return the colour scale of the counts.

    `support` (world frame) replaces the house, which would hide the grasps.
    """
    centre_m = recalled.target_center_m
    half_m = float(recalled.models[0].radius_m) + _HAND_M
    towards = recalled.camera.T_world_camera[:2, 3] - centre_m[:2]
    towards = towards / max(float(np.linalg.norm(towards)), 1e-6)
    eyes = {
        "grasps that succeeded, from above": centre_m + [0, 0, _FAR_M],
        "from the observer's side": centre_m + _FAR_M * np.array([*(0.97 * towards), 0.24]),
    }
    rays = recalled.rays
    stage = RayScene(ray_mesh(support), rays.objects, rays.radii_m, rays.T_world_object)
    scale = None
    if len(used.count):
        scale = ScalarMappable(Normalize(0, float(used.count.max())), colormaps["plasma"])
    for axes, (title, eye_m) in zip(views, eyes.items(), strict=True):
        camera = _camera(eye_m, centre_m, half_m)
        axes.imshow(_faded(render_rays(stage, camera)))
        if scale is not None:
            # The most frequent are drawn last, on top.
            T_world_tcp = recalled.T_world_object[0] @ used.T_target_tcp[::-1]
            _draw_hands(axes, camera, T_world_tcp, hand_outline(gripper), scale.to_rgba(used.count[::-1]))
        axes.set_title(title, fontsize=11)
        axes.set_xlim(-0.5, _SIZE_PX - 0.5)
        axes.set_ylim(_SIZE_PX - 0.5, -0.5)
        axes.set_xticks([])
        axes.set_yticks([])
    return scale


def _faded(frame: Frame) -> U8:
    """The image in pale colours, paler off the target, so that hands stand out."""
    strength = np.where(frame.body == 1, 0.75, 0.4)[..., None]
    return (strength * frame.rgb + (1 - strength) * 255).astype(np.uint8)


def _draw_hands(axes: Axes, camera: Camera, T_world_tcp: F64, outline: F64, colours: F64) -> None:
    for T, colour in zip(T_world_tcp, colours, strict=True):
        px = _project(camera, outline.reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]).reshape(-1, 2, 2)
        axes.add_collection(LineCollection(list(px), colors="black", linewidths=3.0, capstyle="round"))
        axes.add_collection(
            LineCollection(list(px), colors=[tuple(colour)], linewidths=1.9, capstyle="round")
        )


def support_sheet(T_world_support: F64, size_m: F64) -> Mesh:
    """The support's rectangle, of sides (2,), as a thin board in the world frame."""
    x, y = (float(v) / 2 for v in size_m)
    board, _ = join([box((-x, x), (-y, y), (-0.01, 0.0), _SHEET_RGB)])
    return board.transformed(T_world_support)


def _camera(eye_m: F64, centre_m: F64, half_m: float) -> Camera:
    focal_px = _SIZE_PX / 2 / half_m * _FAR_M
    middle = _SIZE_PX / 2
    return Camera(look_at(eye_m, centre_m), _SIZE_PX, _SIZE_PX, focal_px, focal_px, middle, middle)


def _project(camera: Camera, points_m: F64) -> F64:
    """Pixels (N, 2) of world points (N, 3)."""
    T = camera.T_world_camera
    local = (points_m - T[:3, 3]) @ T[:3, :3]
    scale = np.array([camera.fx_px, camera.fy_px]) / local[:, 2:]
    return local[:, :2] * scale + (camera.cx_px, camera.cy_px) - 0.5

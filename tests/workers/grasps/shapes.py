"""A hand of boxes and a few objects whose grasps are known."""

from __future__ import annotations

import numpy as np

from datagen.workers.objects.model import ObjectModel
from datagen.workers.robots.gripper import Gripper
from tests.workers.worlds import box_vertices, coloured, model_of

TIP_M = 0.009  # from the pads' middle to the end of the fingers
PALM_M = 0.037


def box_gripper(max_opening_m: float = 0.08) -> Gripper:
    """A symmetric hand of three boxes; fingers 2 cm wide and 1.4 cm thick."""
    palm = box_vertices((0.06, 0.2, 0.06), (0.0, 0.0, -PALM_M - 0.03))
    length = TIP_M + PALM_M
    left, right = (box_vertices((0.02, 0.014, length), (0.0, s * 0.007, TIP_M - length / 2)) for s in (1, -1))
    return Gripper("boxes", "0" * 64, max_opening_m, (0.02, 2 * TIP_M), PALM_M, (palm,), ((left,), (right,)))


def bowl_model(radius_m: float = 0.07, height_m: float = 0.06, wall_m: float = 0.004) -> ObjectModel:
    """An open vessel of 24 wall segments and a floor, too wide to be taken around."""
    n = 24
    angles = 2 * np.pi * np.arange(n + 1) / n
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    low, high = -height_m / 2, height_m / 2
    parts: list[np.ndarray] = []
    for k in range(n):
        edge = ring[[k, k + 1]]
        corners = np.concatenate([edge * radius_m, edge * (radius_m - wall_m)])
        parts.append(np.concatenate([np.c_[corners, np.full(4, z)] for z in (low, high)]).astype(np.float32))
    base = ring[:n] * radius_m
    floor = np.concatenate([np.c_[base, np.full(n, z)] for z in (low, low + wall_m)]).astype(np.float32)
    parts.append(floor)
    vertices = np.concatenate(parts)
    faces = np.arange(len(vertices) // 3 * 3, dtype=np.int32).reshape(-1, 3)
    return model_of("bowl", coloured(vertices, faces, (200, 200, 200)), parts, 0.15)

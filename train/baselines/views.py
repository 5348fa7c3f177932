"""Coarse images of a coloured cloud from any viewpoint, for detectors."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from datagen.train.inputs import Array

F32 = npt.NDArray[np.float32]
U8 = npt.NDArray[np.uint8]

SIZE_PX = 256
# Covers about half a metre around the target from a metre away.
_HALF_ANGLE_RAD = 0.5
# Width of the square drawn for a point: stored clouds have a point every 2 to 3 cm.
_POINT_M = 0.025
_LARGEST_PX = 24
_NEAREST_M = 0.05
_BACKGROUND = 127


def render_views(points_m: F32, rgb: U8, eyes_m: F32, size_px: int = SIZE_PX) -> U8:
    """Images (N, size, size, 3) from viewpoints (N, 3) that look at the origin, upright.

    Points (P, 3) with colours (P, 3) in the same frame are drawn from far to near as squares that shrink with
    distance; pixels without a point are grey.
    """
    return np.stack([_view(points_m, rgb, eye, size_px) for eye in eyes_m.astype(np.float64)])


def _view(points_m: Array, rgb: U8, eye_m: Array, size_px: int) -> U8:
    picture = np.full((size_px, size_px, 3), _BACKGROUND, np.uint8)
    forward = -eye_m / max(float(np.linalg.norm(eye_m)), 1e-6)
    right = np.array([forward[1], -forward[0], 0.0])
    length = float(np.linalg.norm(right))
    right = right / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    local = (points_m - eye_m) @ np.stack([right, np.cross(forward, right), forward]).T  # right, down, ahead
    ahead = local[:, 2] > _NEAREST_M  # also leaves out what is not finite
    order = np.flatnonzero(ahead)[np.argsort(-local[ahead, 2], kind="stable")]
    x, y, depth_m = local[order].T
    focal_px = size_px / 2 / np.tan(_HALF_ANGLE_RAD)
    width = np.clip(np.ceil(focal_px * _POINT_M / depth_m), 1, _LARGEST_PX).astype(np.int64)
    left = np.floor(focal_px * x / depth_m + size_px / 2 - (width - 1) / 2).astype(np.int64)
    top = np.floor(focal_px * y / depth_m + size_px / 2 - (width - 1) / 2).astype(np.int64)
    seen = (left + width > 0) & (left < size_px) & (top + width > 0) & (top < size_px)
    for i in np.flatnonzero(seen):
        rows, columns = (slice(max(int(a[i]), 0), int(a[i] + width[i])) for a in (top, left))
        picture[rows, columns] = rgb[order[i]]
    return picture

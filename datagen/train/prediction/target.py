"""Find the target's points and estimate its centre from the visible part."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from datagen.schemas.errors import InputError
from datagen.train.inputs import F32, F64, Bools
from datagen.train.prediction.frames import SensorFrame

# No object that a gripper can hold is wider: points farther from a target's middle are of other objects.
_LARGEST_M = 0.30
# Least share and number of a mask's pixels that must have depth: of a pen seen from 2 m some 20 have.
_LEAST_SHARE, _LEAST_POINTS = 0.25, 12
_RIM_PERCENT = 1.0  # left out at either end: noise at the rims


@dataclass(frozen=True)
class TargetBox:
    """Position and size of the target, world frame; `how` describes how it was found."""

    center_m: tuple[float, float, float]
    radius_m: float  # the sphere around the centre that holds the target
    support_height_m: float  # of the surface that it stands on
    narrowest_m: float  # the least of its height and its widths as seen from above
    how: str


@dataclass(frozen=True)
class Filled:
    """Numbers of a mask's pixels: all, and those without depth, which are filled."""

    mask_pixels: int
    missing_pixels: int


def fill_target(frame: SensorFrame) -> tuple[SensorFrame, Filled]:
    """The frame with the nearest pixel's depth where the mask has none. InputError if too few have it."""
    image = frame.image
    assert image is not None and image.mask is not None and frame.on_target is not None
    mask, known = image.mask, image.mask & (image.depth_m > 0)
    wanted, have = int(mask.sum()), int(known.sum())
    if have < max(_LEAST_POINTS, _LEAST_SHARE * wanted):
        problem = f"only {have} of the target's {wanted} pixels have depth"
        fix = "Take the frame from another angle or distance, or add frames"
        raise InputError(frame.place, "target", problem, fix)
    if have == wanted:
        return frame, Filled(wanted, 0)
    (top, *_, bottom), (left, *_, right) = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    box, depth_m = np.s_[top : bottom + 1, left : right + 1], np.zeros_like(image.depth_m)
    depth_m[box] = from_nearest(image.depth_m[box], known[box])
    pixels = np.flatnonzero((mask & ~known).ravel())
    return replace(
        frame,
        points_m=np.concatenate([frame.points_m, image.points(pixels, depth_m)]),
        rgb=np.concatenate([frame.rgb, image.rgb.reshape(-1, 3)[pixels]]),
        on_target=np.concatenate([frame.on_target, np.ones(len(pixels), np.bool_)]),
    ), Filled(wanted, wanted - have)


def from_nearest(values: F32, known: Bools) -> F32:
    """Every pixel's value (H, W) from the nearest pixel that is known."""
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    rows, columns = np.asarray(nearest, np.int64)
    return values[rows, columns]


def locate(target_m: F64, others_m: F32 | F64, eye_m: F64) -> TargetBox:
    """The box of the target from its visible points (N, 3), the others (M, 3) and the camera (3,), world.

    Across the line of sight it spans the visible points; along it their depth, at least the smaller of
    width and height; vertically from the support to the top. InputError for too few points.
    """
    middle = np.median(target_m, axis=0)
    kept = target_m[np.linalg.norm(target_m - middle, axis=1) < _LARGEST_M]
    if len(kept) < _LEAST_POINTS:
        problem = f"has {len(kept)} points, but {_LEAST_POINTS} are needed"
        fix = "Give a mask of the whole target, or a frame that shows more of it"
        raise InputError("target", "", problem, fix)
    ahead = kept[:, :2].mean(axis=0) - eye_m[:2]
    far_m = float(np.linalg.norm(ahead))
    ahead = ahead / far_m if far_m > 1e-6 else np.array([0.0, 1.0])
    across = np.array([-ahead[1], ahead[0]])
    (front, back), (right, left), (low, top) = (
        np.percentile(values, (_RIM_PERCENT, 100 - _RIM_PERCENT))
        for values in (kept[:, :2] @ ahead, kept[:, :2] @ across, kept[:, 2])
    )
    width = left - right
    support = _support_under(others_m, kept[:, :2].mean(axis=0), width / 2 + 0.12, low)
    # Tops show how deep boxes are; the backs of round objects are hidden; flat objects hide nothing.
    deep = max(back - front, min(width, top - support))
    centre_xy = (front + deep / 2) * ahead + (left + right) / 2 * across
    centre = np.array([*centre_xy, (top + support) / 2])
    corners = np.concatenate([kept, np.column_stack([kept[:, :2], np.full(len(kept), support)])])
    radius_m = float(np.percentile(np.linalg.norm(corners - centre, axis=1), 100 - _RIM_PERCENT))
    guessed = " (guessed by its width and height)" if deep > back - front else ""
    how = (
        f"box of the visible points: {width:.3f} m across, {deep:.3f} m along the sight line{guessed}, "
        f"{top - support:.3f} m over a support at {support:.3f} m"
    )
    x, y, z = (float(c) for c in centre)
    narrowest_m = min(_least_width_m(kept[:, :2], centre_xy), float(top - support))
    return TargetBox((x, y, z), radius_m, support, narrowest_m, how)


def _least_width_m(xy_m: F64, centre_xy_m: F64) -> float:
    """The least width of points (N, 2) and their copy turned by half a turn about the centre (2,)."""
    angle = np.linspace(0.0, np.pi, 36, endpoint=False)
    along = (xy_m - centre_xy_m) @ np.stack([np.cos(angle), np.sin(angle)])
    return float(2 * np.percentile(np.abs(along), 100 - _RIM_PERCENT, axis=0).min())


def _support_under(others_m: F32 | F64, middle_xy: F64, half_m: float, low_m: float) -> float:
    """Height of the target's support: where most points around its foot lie, or its lowest point."""
    x, y = (np.abs(others_m[:, k] - middle_xy[k]) < half_m for k in range(2))
    z = others_m[x & y, 2].astype(np.float64)
    z = z[(z < low_m + 0.03) & (z > low_m - 0.1)]
    if len(z) < 50:
        return float(low_m)
    counted, edges = np.histogram(z, np.arange(low_m - 0.1, low_m + 0.035, 0.005))
    k = int(counted.argmax())
    return float(np.median(z[(z >= edges[k] - 0.0025) & (z <= edges[k + 1] + 0.0025)]))

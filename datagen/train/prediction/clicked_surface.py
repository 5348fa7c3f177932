"""Refuse a click on a wall, a table or the floor: a plane far wider than a gripper can hold."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from datagen.schemas.errors import InputError
from datagen.train.inputs import F32, F64, Bools
from datagen.train.prediction.ground import depth_error_m

_NEAR_PX = 6  # around the click, for the plane through it
_SECTORS = 8  # sectors of directions in which the plane is followed
# A plane that extends this far in this number of sectors is a surface of the room; a corner fills a quarter.
_FAR_SHARE, _LEAST_SECTORS = 0.8, 3
_LEAST_FILLED = 0.5  # share of such a sector's ring that the plane fills
_LEVEL, _UPRIGHT = 0.9, 0.3  # limits of the normal's z
_ON_FLOOR_M = 0.04
_FIX = "Click on the target itself, or give its mask"


def refuse_surface(
    grid: F64,
    facets: F64,
    depth_m: F32,
    joined: Bools,
    click: tuple[int, int],
    pixel: tuple[int, int],
    within_m: float,
) -> None:
    """InputError where pixel (u, v) lies on a plane that extends at least about `within_m` around it.

    `grid` (H, W, 3) are the pixels' points and `facets` (H, W, 3) their areas times normals, world; `joined`
    (H, W) is false where depth jumps. The error names `pixel`, the pixel in the full image.
    """
    u, v = click
    patch = np.s_[max(v - _NEAR_PX, 0) : v + _NEAR_PX + 1, max(u - _NEAR_PX, 0) : u + _NEAR_PX + 1]
    alike = np.abs(depth_m[patch] - depth_m[v, u]) < 0.02
    normal = facets[patch][alike].sum(axis=0)
    length = float(np.linalg.norm(normal))
    if length < 1e-12:
        return
    normal /= length
    rel = grid - np.median(grid[patch][alike], axis=0)
    off_m = np.abs(rel @ normal)
    gap_m = np.linalg.norm(rel, axis=2)
    on = joined & (depth_m > 0) & (gap_m < within_m) & (off_m < 0.006 + 2 * depth_error_m(depth_m))
    # A plane's pixels face the same way: a strip that it cuts from another surface does not count.
    along = np.einsum("ijk,k->ij", facets, normal)
    on &= along > 0.8 * np.linalg.norm(facets, axis=2)
    labels = np.zeros(on.shape, np.int64)
    ndimage.label(ndimage.binary_closing(on) | (gap_m < 0.01), output=labels)
    on &= labels == labels[v, u]
    across = np.cross(normal, [0.0, 0.0, 1.0] if abs(normal[2]) < _LEVEL else [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    plane = np.stack([rel @ across, rel @ np.cross(normal, across)], axis=2)
    ring = on & (gap_m > (_FAR_SHARE - 0.2) * within_m) & (gap_m < _FAR_SHARE * within_m)
    angle = np.arctan2(plane[ring][:, 1], plane[ring][:, 0])
    fine = np.bincount(
        ((angle / (2 * np.pi) + 0.5) * 4 * _SECTORS).astype(int) % (4 * _SECTORS), minlength=4 * _SECTORS
    )
    reached = (fine > 2).reshape(_SECTORS, 4).mean(axis=1) >= _LEAST_FILLED
    if reached.sum() < _LEAST_SECTORS:
        return
    long_m, short_m = np.sort(np.ptp(plane[on], axis=0))[::-1]
    raise InputError(
        "--click", f"{pixel[0]},{pixel[1]}", f"lies on {_words(normal, grid[on], long_m, short_m)}", _FIX
    )


def _words(normal: F64, points_m: F64, long_m: float, short_m: float) -> str:
    size = f"at least {long_m:.2f} x {short_m:.2f} m"
    height_m = float(np.median(points_m[:, 2]))
    if abs(normal[2]) > _LEVEL:
        if abs(height_m) < _ON_FLOOR_M:
            return f"the floor ({size})"
        return f"a level surface {height_m:.2f} m above the floor ({size}), as of a table"
    if abs(normal[2]) < _UPRIGHT:
        return f"an upright plane ({size}), as of a wall or a cabinet"
    return f"a sloping plane ({size})"

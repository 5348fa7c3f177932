"""Segment the object at a clicked pixel by region growing above its support."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from datagen.schemas.errors import InputError
from datagen.train.inputs import F32, F64, Bools
from datagen.train.prediction.frames import RgbdImage
from datagen.train.prediction.ground import depth_error_m, floor_points
from datagen.train.prediction.target import from_nearest

_GROWS_M = 0.24  # largest distance from the clicked point
# A region that grows beyond this share of that distance has spread over a surface.
_RAN_OUT, _ROUNDS = 0.95, 4
_FEW_FAR = 0.01  # share of the region's pixels that may be that far
_SUPPORT_AREA_M2 = 0.004  # a smaller level surface is no support
_BIN_M = 0.004
_LARGEST_M = 0.45  # a larger region is furniture, or several objects


def grow_mask(image: RgbdImage, click: tuple[int, int], T_world_camera: F64) -> Bools:
    """Mask (H, W) of the object at pixel (u, v), by region growing above its support.

    The region grows to neighbours of similar depth, above the largest level surface below the clicked point;
    where it spreads over a higher surface, that surface is the support. InputError for a click on a wall, a
    table or the floor, and for a region that grows into its surroundings.
    """
    h, w = image.depth_m.shape
    u, v = click
    if not (0 <= u < w and 0 <= v < h):
        raise InputError("--click", f"{u},{v}", f"is outside the image of {w}x{h}", "Give a pixel u,v in it")
    u, v = image.pixel_of(u, v)
    depth_m = image.depth_m
    if depth_m[v, u] == 0:
        near = (depth_m[max(v - 15, 0) : v + 16, max(u - 15, 0) : u + 16] > 0).any()
        fix = "Give another pixel of the target" if near else "Take the frame again, or give its box or mask"
        raise InputError("--click", f"{click[0]},{click[1]}", "has no depth", fix)
    # Pixels outside the window are farther than `_GROWS_M` from the point.
    around_px = max(image.pinhole.fx_px, image.pinhole.fy_px) * _GROWS_M / max(depth_m[v, u] - _GROWS_M, 0.1)
    n = int(around_px) + 16
    left, top = max(u - n, 0), max(v - n, 0)
    window = np.s_[top : v + n, left : u + n]
    mask = np.zeros((h, w), np.bool_)
    mask[window] = _grown(image.cut(left, top, u + n, v + n), (u - left, v - top), T_world_camera, click)
    return mask


def _grown(image: RgbdImage, click: tuple[int, int], T_world_camera: F64, pixel: tuple[int, int]) -> Bools:
    """The mask of an image around pixel (u, v), which is `pixel` in the full image."""
    (h, w), (u, v), depth_m = image.depth_m.shape, click, image.depth_m
    facets, grid = image.facets(T_world_camera), image.world_grid(T_world_camera)
    seed = grid[v, u]
    far_m = np.linalg.norm(grid - seed, axis=2)
    around = (depth_m > 0) & (far_m < _GROWS_M)
    joined = ~depth_breaks(depth_m) | _disc((h, w), (u, v), 2)
    level = around & (grid[..., 2] < seed[2] - 0.003)
    allowed = grown = np.zeros((h, w), np.bool_)
    # Whether the object is off the floor and above its support, and ends within `_GROWS_M`.
    on_floor = bool(floor_points(seed[None], T_world_camera[:3, 3])[0])
    stands_out = not on_floor
    for k in range(_ROUNDS):
        lowest_m = above_support(grid, facets, level, seed)
        stands_out &= k > 0 or seed[2] > lowest_m
        allowed = around & (grid[..., 2] > min(lowest_m, seed[2] - 1e-4))
        labels = np.zeros((h, w), np.int64)
        ndimage.label(allowed & joined, output=labels)
        grown = (labels == labels[v, u]) & allowed & joined
        if not grown.any() or far_m[grown].max() < _RAN_OUT * _GROWS_M:
            break
        level = grown & (grid[..., 2] < seed[2] - 0.003)
    else:
        stands_out = False
    if not stands_out:
        refuse_surface(grid, facets, depth_m, joined, click, pixel, _GROWS_M)
    if on_floor:
        fix = "Click higher on the target, or give its box or mask"
        raise InputError("--click", f"{pixel[0]},{pixel[1]}", "lies on the floor", fix)
    grown[v, u] = True
    # Rim pixels without a label are the target's where they are as near as the target next to them.
    rim = np.asarray(ndimage.binary_dilation(grown, iterations=2), np.bool_) & allowed
    step_m = np.abs(depth_m - from_nearest(depth_m, grown))
    filled = np.asarray(ndimage.binary_fill_holes(grown | (rim & (step_m < _step_m(depth_m)))), np.bool_)
    mask = filled & (depth_m > 0)
    _refuse_spread(grid, mask, far_m, pixel)
    refuse_large(grid[mask], "--click", f"{pixel[0]},{pixel[1]}")
    return mask


def refuse_large(points_m: F64, option: str, value: str) -> None:
    """Raise InputError where a mask's world points (N, 3) are those of furniture or of several objects."""
    low, high = np.percentile(points_m, (2, 98), axis=0)
    wide_m, tall_m = float(np.hypot(*(high - low)[:2])), float((high - low)[2])
    if max(wide_m, tall_m) > _LARGEST_M:
        problem = f"selects a region {wide_m:.2f} m wide and {tall_m:.2f} m high, more than a hand can grasp"
        raise InputError(option, value, problem, "Give a narrower --box around the target, or its mask")


def _refuse_spread(grid: F64, mask: Bools, far_m: F64, pixel: tuple[int, int]) -> None:
    """Raise InputError where the region grows up to its largest distance, into its surroundings."""
    points = grid[mask]
    x, y, z = np.ptp(points, axis=0)
    size = f"{max(x, y):.2f} x {min(x, y):.2f} m wide and {z:.2f} m high"
    far = int((far_m[mask] > _RAN_OUT * _GROWS_M).sum())
    if far > _FEW_FAR * len(points):
        problem = f"grows into its surroundings: a region {size}, {points[:, 2].mean():.2f} m above the floor"
        raise InputError(
            "--click", f"{pixel[0]},{pixel[1]}", problem, "Click on another pixel, or give its box or mask"
        )


def above_support(grid: F64, facets: F64, among: Bools, seed: F64) -> float:
    """Height above which points belong to objects on the widest level surface `among` pixels (H, W)."""
    areas = np.linalg.norm(facets, axis=2)
    rows = among & (facets[..., 2] > 0.9 * areas) & (areas > 0)
    z = grid[rows][:, 2]
    if not len(z):
        return float(seed[2] - _GROWS_M)
    edges = np.arange(z.min() - _BIN_M, z.max() + 2 * _BIN_M, _BIN_M)
    # At an edge, smoothed depth runs from one object to the other: the weight of a pixel is bounded.
    counted, _ = np.histogram(z, edges, weights=np.minimum(areas[rows], 10 * np.median(areas[rows])))
    spread = np.convolve(counted, np.ones(3), mode="same")
    k = int(spread.argmax())
    if spread[k] < _SUPPORT_AREA_M2:
        return float(seed[2] - _GROWS_M)
    height_m = float(np.median(z[np.abs(z - (edges[k] + edges[k + 1]) / 2) < 1.5 * _BIN_M]))
    near = np.abs(z[np.abs(z - height_m) < 0.015] - height_m)
    return height_m + 0.004 + 3 * 1.48 * float(np.median(near))


def _step_m(depth_m: F32) -> F64:
    """Difference in depth of neighbouring pixels from which on they belong to different objects."""
    return 0.008 + 3 * depth_error_m(depth_m)


def depth_breaks(depth_m: F32) -> Bools:
    """Pixels (H, W) at a jump in depth that slope does not explain, or next to missing depth."""
    smooth = ndimage.median_filter(depth_m, 3)
    breaks = np.zeros(depth_m.shape, np.bool_)
    for axis in (0, 1):
        a, marks = np.moveaxis(smooth, axis, 0), np.moveaxis(breaks, axis, 0)
        step = np.diff(a, axis=0)
        padded = np.concatenate([step[:1], step, step[-1:]])
        unlike = np.minimum(np.abs(step - padded[:-2]), np.abs(step - padded[2:]))
        jump = unlike > _step_m(np.minimum(a[:-1], a[1:]))
        nearer = a[:-1] < a[1:]
        # Only farther pixels are left out: the rim of the nearer object belongs to it.
        marks[:-1] |= jump & ~nearer
        marks[1:] |= jump & nearer
    return breaks


def _disc(shape: tuple[int, int], centre: tuple[int, int], radius: int) -> Bools:
    v, u = np.ogrid[: shape[0], : shape[1]]
    return (u - centre[0]) ** 2 + (v - centre[1]) ** 2 <= radius**2


_NEAR_PX = 6  # around the click, for the plane through it
_SECTORS = 8  # sectors of directions in which the plane is followed
# A plane that extends this far in this number of sectors is a surface of the room; a corner fills a quarter.
_FAR_SHARE, _LEAST_SECTORS = 0.8, 3
_LEAST_FILLED = 0.5  # share of such a sector's ring that the plane fills
_LEVEL, _UPRIGHT = 0.9, 0.3  # limits of the normal's z
_ON_FLOOR_M = 0.04
_FIX = "Click on the target itself, or give its box or mask"


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

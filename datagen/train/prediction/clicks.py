"""Segment the object at a clicked pixel, or in a box; refuse what no hand can grasp."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from datagen.schemas.errors import InputError
from datagen.train.inputs import F32, F64, Bools
from datagen.train.prediction.click_network import object_logits
from datagen.train.prediction.frames import RgbdImage, moved
from datagen.train.prediction.ground import depth_error_m, floor_points
from datagen.train.prediction.target import from_nearest

_LARGEST_M = 0.45  # a larger region is furniture, or several objects
_LEAST_PX = 20
_NEXT_PX = 2  # a mask may begin this far from the click
_RING_PX, _OFF_PLANE_M = (3, 9), 0.004  # around a mask, where a plane would continue; its noise at 0 m
_JUMP_M, _LEAST_SHARE = 0.03, 0.1  # between parts of a region, and the least part that belongs to it
_PATCH_PX = 12  # around a click on a surface, to say which
_LEVEL, _UPRIGHT, _ON_FLOOR_M = 0.9, 0.3, 0.04
# Where in a box an object is looked for, and the least overlap of the object's own box with it.
_PLACES = ((0.5, 0.5), (0.3, 0.5), (0.7, 0.5), (0.5, 0.3), (0.5, 0.7))
_LEAST_OVERLAP = 0.3
_FIX = "Click on the target itself, or give its box or mask"

Box = tuple[int, int, int, int]


def click_mask(image: RgbdImage, click: tuple[int, int], T_world_camera: F64) -> Bools:
    """Mask (H, W) of the object at pixel (u, v), as `click_network` sees it.

    InputError where nothing was measured, for a click on a wall, a table or the floor, and for a region of
    the size of furniture.
    """
    h, w = image.depth_m.shape
    u, v = click
    if not (0 <= u < w and 0 <= v < h):
        raise InputError("--click", f"{u},{v}", f"is outside the image of {w}x{h}", "Give a pixel u,v in it")
    u, v = image.pixel_of(u, v)
    depth_m, said = image.depth_m, f"{click[0]},{click[1]}"
    if depth_m[v, u] == 0:
        near = (depth_m[max(v - 15, 0) : v + 16, max(u - 15, 0) : u + 16] > 0).any()
        fix = "Give another pixel of the target" if near else "Take the frame again, or give its box or mask"
        raise InputError("--click", said, "has no depth", fix)
    point_m = moved(image.points(np.array([v * w + u])), T_world_camera)
    on_floor = bool(floor_points(point_m, T_world_camera[:3, 3])[0])
    mask = None if on_floor else _masked(image, (u, v), T_world_camera)
    if mask is None or _is_part_of_plane(mask, depth_m):
        raise InputError("--click", said, f"lies on {_surface(image, (u, v), T_world_camera)}", _FIX)
    refuse_large(image, mask, T_world_camera, "--click", said)
    return mask


def _masked(image: RgbdImage, pixel: tuple[int, int], T_world_camera: F64) -> Bools | None:
    """The region of the object next to a pixel with depth; None where it is on none."""
    u, v = pixel
    likely = (object_logits(image, pixel, T_world_camera) > 0) & (image.depth_m > 0)
    labels = np.zeros(likely.shape, np.int64)
    ndimage.label(likely, np.ones((3, 3)), output=labels)
    near = labels[max(v - _NEXT_PX, 0) : v + _NEXT_PX + 1, max(u - _NEXT_PX, 0) : u + _NEXT_PX + 1]
    if not near.any():
        return None
    mask = _without_specks(labels == np.bincount(near[near > 0]).argmax(), image.depth_m)
    return mask if mask.sum() >= _LEAST_PX else None


def _without_specks(mask: Bools, depth_m: F32) -> Bools:
    """A region less what lies at another depth than its larger parts: pixels of what is behind its rim."""
    step_m = ndimage.maximum_filter(np.where(mask, depth_m, 0), 3)
    step_m = step_m - ndimage.minimum_filter(np.where(mask, depth_m, np.inf), 3)
    parts = np.zeros(mask.shape, np.int64)
    ndimage.label(mask & (step_m < _JUMP_M), np.ones((3, 3)), output=parts)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    large = sizes[parts] >= _LEAST_SHARE * mask.sum()
    return mask & (np.abs(depth_m - from_nearest(depth_m, large)) < _JUMP_M) if large.any() else mask


def _is_part_of_plane(mask: Bools, depth_m: F32) -> bool:
    """Whether a region is a patch of a plane that continues around it.

    On a plane the inverse of depth is linear.
    """
    near, next_to = (np.asarray(ndimage.binary_dilation(mask, iterations=n), np.bool_) for n in _RING_PX)
    inside, around = (np.argwhere(pixels & (depth_m > 0)) for pixels in (mask, next_to & ~near))
    if len(around) < _LEAST_PX:
        return False
    there_m, beyond_m = depth_m[tuple(inside.T)], depth_m[tuple(around.T)]
    plane = np.linalg.lstsq(np.insert(inside, 2, 1, axis=1), 1 / there_m, rcond=None)[0]
    most_m = _OFF_PLANE_M + 2 * float(depth_error_m(there_m).mean())
    flat, same = (
        np.mean(np.abs(1 / np.maximum(np.insert(at, 2, 1, axis=1) @ plane, 1e-3) - m) < most_m)
        for at, m in ((inside, there_m), (around, beyond_m))
    )
    return bool(flat > 0.85 and same > 0.7)


def box_mask(image: RgbdImage, box: Box, T_world_camera: F64) -> Bools:
    """Mask (H, W) of the object in a box: left, top, right, bottom; the last two exclusive.

    Of the objects at five places in the box the one whose own box fits best, cut at the box. InputError for a
    box outside the image, for one that no object fills, and for an object of the size of furniture.
    """
    h, w = image.depth_m.shape
    text, (left, top, right, bottom) = ",".join(map(str, box)), box
    if not (0 <= left < right - 2 and 0 <= top < bottom - 2 and right <= w and bottom <= h):
        problem = f"is no box of 3 pixels or more in the image of {w}x{h}"
        raise InputError("--box", text, problem, "Give LEFT,TOP,RIGHT,BOTTOM in pixels")
    if image.source is not None:
        ends = np.array([image.pixel_of(u, v) for u in (left, right - 1) for v in (top, bottom - 1)])
        (left, top), (right, bottom) = ends.min(axis=0), ends.max(axis=0) + 1
    v, u = np.nonzero(image.depth_m[top:bottom, left:right])
    if not len(v):
        raise InputError("--box", text, "has no depth", "Take the frame again, or give the target's mask")
    size = right - left, bottom - top
    nearest = {int(np.hypot(u - x * size[0], v - y * size[1]).argmin()) for x, y in _PLACES}
    best, cut = 0.0, np.zeros(image.depth_m.shape, np.bool_)
    for k in sorted(nearest):
        mask = _masked(image, (left + int(u[k]), top + int(v[k])), T_world_camera)
        if mask is None or mask[top:bottom, left:right].sum() < _LEAST_PX:
            continue
        if (overlap := _overlap(mask, (left, top, right, bottom))) > best:
            best, cut[:] = overlap, False
            cut[top:bottom, left:right] = mask[top:bottom, left:right]
    if best < _LEAST_OVERLAP:
        fix = "Give the sides of a box around the target, or its mask"
        raise InputError("--box", text, "has no object in it that fills it", fix)
    refuse_large(image, cut, T_world_camera, "--box", text)
    return cut


def _overlap(mask: Bools, box: Box) -> float:
    """Intersection over union of a mask's box with another."""
    rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    left, top, right, bottom = int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
    across = min(right, box[2]) - max(left, box[0])
    down = min(bottom, box[3]) - max(top, box[1])
    both = max(across, 0) * max(down, 0)
    areas = (right - left) * (bottom - top) + (box[2] - box[0]) * (box[3] - box[1])
    return both / (areas - both)


def refuse_large(image: RgbdImage, mask: Bools, T_world_camera: F64, option: str, value: str) -> None:
    """Raise InputError where a mask is that of furniture or of several objects."""
    points_m = image.points(np.flatnonzero(mask)) @ T_world_camera[:3, :3].T
    low, high = np.percentile(points_m, (2, 98), axis=0)
    wide_m, tall_m = float(np.hypot(*(high - low)[:2])), float((high - low)[2])
    if max(wide_m, tall_m) > _LARGEST_M:
        problem = f"selects a region {wide_m:.2f} m wide and {tall_m:.2f} m high, more than a hand can grasp"
        raise InputError(option, value, problem, "Give a narrower --box around the target, or its mask")


def _surface(image: RgbdImage, pixel: tuple[int, int], T_world_camera: F64) -> str:
    """What kind of surface of the room a pixel lies on."""
    (u, v), n = pixel, _PATCH_PX
    part = image.cut(max(u - n, 0), max(v - n, 0), u + n + 1, v + n + 1)
    normal = part.facets(T_world_camera)[part.depth_m > 0].sum(axis=0)
    rise = abs(normal[2]) / max(float(np.linalg.norm(normal)), 1e-12)
    height_m = float(np.median(part.world_grid(T_world_camera)[..., 2][part.depth_m > 0]))
    if rise > _LEVEL:
        return (
            "the floor"
            if abs(height_m) < _ON_FLOOR_M
            else f"a level surface {height_m:.2f} m above the floor"
        )
    return "an upright plane, as of a wall or a cabinet" if rise < _UPRIGHT else "nothing that stands out"

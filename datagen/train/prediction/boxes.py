"""Segment the object in a box: what stands on the support there, and does not continue outside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from datagen.schemas.errors import InputError
from datagen.train.inputs import F64, Bools
from datagen.train.prediction.frames import RgbdImage
from datagen.train.prediction.region_growing import above_support, depth_breaks, grow_mask, refuse_large
from datagen.train.prediction.target import from_nearest

Box = tuple[int, int, int, int]
_AROUND, _SLACK = 0.5, 0.04  # shares of the box: the margin that is looked at; the error of its sides
# Least share of a part's pixels that lie in the box, and of the sides that a grown region spans.
_INSIDE, _SPANS = 0.8, 0.7
_JUMP_M = 0.03  # between the main part and others at the pixels where they are next to each other
_LEAST_PX, _LEAST_SHARE = 30, 0.05
_FIX = "Give the sides of a box around the target, or its mask"


def box_mask(image: RgbdImage, box: Box, T_world_camera: F64) -> Bools:
    """Mask (H, W) of the object that fills most of a box: left, top, right, bottom; the last two exclusive.

    What a click on its middle selects, if it spans the box. Else parts end where depth jumps, and on the
    widest level surface; those that lie in the box belong to the object, which is cut at the box if it
    continues outside. InputError for a box outside the image, for one in which nothing stands, and for an
    object of the size of furniture.
    """
    h, w = image.depth_m.shape
    text, (left, top, right, bottom) = ",".join(map(str, box)), box
    if not (0 <= left < right - 2 and 0 <= top < bottom - 2 and right <= w and bottom <= h):
        problem = f"is no box of 3 pixels or more in the image of {w}x{h}"
        raise InputError("--box", text, problem, "Give LEFT,TOP,RIGHT,BOTTOM in pixels")
    if image.source is not None:
        ends = np.array([image.pixel_of(u, v) for u in (left, right - 1) for v in (top, bottom - 1)])
        (left, top), (right, bottom) = ends.min(axis=0), ends.max(axis=0) + 1
    du, dv = int(_AROUND * (right - left)) + 8, int(_AROUND * (bottom - top)) + 8
    x0, y0, x1, y1 = max(left - du, 0), max(top - dv, 0), min(right + du, w), min(bottom + dv, h)
    part = image.cut(x0, y0, x1, y1)
    v, u = np.ogrid[y0:y1, x0:x1]
    slack_u, slack_v = 2 + _SLACK * (right - left), 2 + _SLACK * (bottom - top)
    inside = (u >= left - slack_u) & (u < right + slack_u) & (v >= top - slack_v) & (v < bottom + slack_v)
    middle = (np.abs(2 * u - left - right) < (right - left) / 2) & (
        np.abs(2 * v - top - bottom) < (bottom - top) / 2
    )
    found = np.zeros((h, w), np.bool_)
    cut = np.s_[y0:y1, x0:x1]
    grown = _grown_in(image, (left, top, right, bottom), T_world_camera)
    if grown is not None and grown[cut][inside].sum() > _INSIDE * grown.sum():
        found[cut] = grown[cut] & inside
        return found
    grid, depth_m = part.world_grid(T_world_camera), part.depth_m
    known = depth_m > 0
    if (known & inside).sum() < _LEAST_PX:
        raise InputError("--box", text, "has no depth", "Take the frame again, or give the target's mask")
    near_m = float(np.percentile(depth_m[known & middle], 25)) if (known & middle).any() else np.inf
    near_m = min(near_m, float(np.median(depth_m[known & inside])))
    around = known & (np.abs(depth_m - near_m) < 0.5)
    top_m = np.percentile(grid[..., 2][around & inside], 95) if (around & inside).any() else 0.0
    lowest_m = above_support(
        grid,
        part.facets(T_world_camera),
        around & ~inside & (grid[..., 2] < top_m),
        np.array([0.0, 0.0, top_m]),
    )
    standing = around & (grid[..., 2] > lowest_m)
    labels = np.zeros(depth_m.shape, np.int64)
    ndimage.label(standing & ~depth_breaks(depth_m), output=labels)
    within = np.bincount(labels[inside], minlength=labels.max() + 1)
    share = within / np.maximum(np.bincount(labels.ravel(), minlength=len(within)), 1)
    central = np.bincount(labels[middle], minlength=len(within)) + 0.25 * within
    central[0] = 0
    main = int((central * share).argmax())
    if central[main] < _LEAST_PX / 4:
        raise InputError("--box", text, "has nothing in it that stands on a surface", _FIX)
    mask = labels == main
    step_m = np.abs(depth_m - from_nearest(depth_m, mask))
    next_to = np.asarray(ndimage.binary_dilation(mask, iterations=4), np.bool_) & (step_m < _JUMP_M)
    whole = np.setdiff1d(labels[next_to], np.append(np.flatnonzero(share <= _INSIDE), 0))
    # Rims, which jumps of depth leave out, are the object's where they are as near as it.
    rim = np.asarray(ndimage.binary_dilation(mask, iterations=2), np.bool_) & standing & (step_m < _JUMP_M)
    mask = np.asarray(ndimage.binary_fill_holes(mask | np.isin(labels, whole) | rim), np.bool_)
    mask &= inside & known
    if mask.sum() < max(_LEAST_PX, _LEAST_SHARE * (right - left) * (bottom - top)):
        raise InputError("--box", text, f"has only {mask.sum()} pixels of an object in it", _FIX)
    refuse_large(grid[mask], "--box", text)
    found[cut] = mask
    return found


def _grown_in(image: RgbdImage, box: Box, T_world_camera: F64) -> Bools | None:
    """What a click on the middle of the box selects, if it spans most of the box both ways."""
    left, top, right, bottom = box
    v, u = np.nonzero(image.depth_m[top:bottom, left:right])
    if not len(v):
        return None
    k = int(np.hypot(u - (right - left) / 2, v - (bottom - top) / 2).argmin())
    try:
        mask = grow_mask(replace(image, source=None), (left + int(u[k]), top + int(v[k])), T_world_camera)
    except InputError:
        return None
    tall, wide = (np.ptp(np.flatnonzero(mask.any(axis))) for axis in (1, 0))
    return mask if tall > _SPANS * (bottom - top) and wide > _SPANS * (right - left) else None

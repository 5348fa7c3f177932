"""Noise model of a stereo depth camera: noise that grows with depth, and holes.

Depth comes from matching: disparity = fx * baseline / depth. A matching error of sigma_d pixels
therefore moves depth by sigma_z = depth^2 * sigma_d / (fx * baseline) (Khoshelham and Elberink 2012,
Sensors 12(2), eq. 10). Surfaces seen at a grazing angle and the edges of objects match poorly and
often give no depth (Nguyen, Izadi and Lovell 2012, 3DIMPVT; Mallick, Das and Majumdar 2014).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from datagen.schemas.specification import NoiseParams
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.rendering import Camera, Frame

# Matchers interpolate between pixels and report this fraction of one: a D4 camera's 1/32.
_DISPARITY_STEP_PX = 1 / 32
# Neighbours whose depths differ by more than this share, beyond what slope explains, are an edge.
_EDGE_SHARE = 0.03
_HOLE_RADIUS_PX = (1.0, 4.0)

Mask = npt.NDArray[np.bool_]


def add_noise(frame: Frame, params: NoiseParams, rng: np.random.Generator) -> Frame:
    """The frame with a stereo camera's errors in its depth; colours and bodies stay.

    A pixel without depth keeps none, and lost pixels have depth 0. The caller checks
    `params.enabled`.
    """
    exact = frame.depth_m
    measured = exact > 0
    # Every frame draws all random numbers in the same order, so that disabling one effect does not
    # change the others.
    matched = rng.standard_normal(exact.shape, dtype=np.float32)
    edge_draws = rng.random(exact.shape, dtype=np.float32)
    holes = _holes(exact.shape, params.hole_rate, rng)

    depth_m = _matched_depth(exact, measured, frame.camera, params, matched)
    edge = _edges(exact)
    lost = holes | (edge & (edge_draws < params.edge_dropout))
    # Next to an edge the normal is undefined.
    lost |= ~edge & (_facing(exact, frame.camera) < params.grazing_dropout_cos)
    depth_m[lost | ~measured] = 0.0
    return replace(frame, depth_m=depth_m)


def _matched_depth(exact: F32, measured: Mask, camera: Camera, params: NoiseParams, matched: F32) -> F32:
    """Depth (H, W) from the matched disparity: with a normal error, rounded to whole steps.

    The smallest disparity is one step, which bounds the depth.
    """
    focal_baseline = camera.fx_px * params.baseline_m
    disparity_px = focal_baseline / np.where(measured, exact, 1.0).astype(np.float64)
    disparity_px += params.disparity_std_px * matched
    disparity_px = np.round(disparity_px / _DISPARITY_STEP_PX) * _DISPARITY_STEP_PX
    return (focal_baseline / np.maximum(disparity_px, _DISPARITY_STEP_PX)).astype(np.float32)


def _edges(exact: F32) -> Mask:
    """Pixels (H, W) on either side of a jump in depth, or of the border to pixels without depth.

    Inverse depth is linear over a plane, so its second difference shows jumps and not slopes.
    """
    inverse = np.where(exact > 0, 1 / np.where(exact > 0, exact, 1.0), 0.0)
    edge = np.zeros(exact.shape, np.bool_)
    for axis in (0, 1):
        near = np.moveaxis(inverse, axis, 0)
        marks = np.moveaxis(edge, axis, 0)
        step = np.diff(near, axis=0)
        padded = np.concatenate([step[:1], step, step[-1:]])
        # A step on a slope resembles a neighbouring step; a step at an edge resembles neither.
        unlike = np.minimum(np.abs(step - padded[:-2]), np.abs(step - padded[2:]))
        jump = unlike > _EDGE_SHARE * np.maximum(near[:-1], near[1:])
        marks[:-1] |= jump
        marks[1:] |= jump
    return edge


def _facing(exact: F32, camera: Camera) -> F64:
    """|cosine| (H, W) between the sight line and the surface's normal, from neighbouring depths.

    1 where there is no depth or the image has a single row or column.
    """
    h, w = exact.shape
    if min(h, w) < 2:
        return np.ones((h, w))
    x = (np.arange(w) + 0.5 - camera.cx_px) / camera.fx_px
    y = (np.arange(h) + 0.5 - camera.cy_px) / camera.fy_px
    rays = np.stack([*np.broadcast_arrays(x[None, :], y[:, None]), np.ones((h, w))], axis=2)
    points_m = rays * exact[..., None]
    normals = np.cross(np.gradient(points_m, axis=1), np.gradient(points_m, axis=0))
    lengths = np.linalg.norm(normals, axis=2) * np.linalg.norm(rays, axis=2)
    cosine = np.abs(np.einsum("ijk,ijk->ij", normals, rays)) / np.maximum(lengths, 1e-30)
    return np.where((lengths > 0) & (exact > 0), cosine, 1.0)


def _holes(shape: tuple[int, int], rate: float, rng: np.random.Generator) -> Mask:
    """Round holes (H, W) that cover the share `rate` of an image on average, whatever its size.

    Their centres may lie outside the image, as otherwise its rim would have fewer holes.
    """
    low, high = _HOLE_RADIUS_PX
    margin = int(np.ceil(high))
    h, w = shape[0] + 2 * margin, shape[1] + 2 * margin
    # Mean area of a disc whose radius is uniform; overlap leaves exp(-density * area) uncovered.
    mean_area = np.pi * (high**3 - low**3) / (3 * (high - low))
    density = -np.log1p(-min(rate, 1 - 1e-9)) / mean_area
    count = int(rng.poisson(density * h * w))
    centres = rng.random((count, 2)) * (h, w)
    radii = rng.uniform(low, high, count)
    covered = np.zeros((h, w), np.bool_)
    reach = np.arange(-margin, margin + 1)
    for dy in reach:
        for dx in reach:
            row, column = centres.astype(np.int64).T + np.array([[dy], [dx]])
            gap = np.hypot(row + 0.5 - centres[:, 0], column + 0.5 - centres[:, 1])
            inside = (gap < radii) & (row >= 0) & (row < h) & (column >= 0) & (column < w)
            covered[row[inside], column[inside]] = True
    return covered[margin:-margin, margin:-margin]

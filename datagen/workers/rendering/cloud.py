"""The fixed-size point cloud around the target that a scene stores."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from datagen.schemas.specification import ObservationParams
from datagen.workers.geometry.mesh import F32, F64, U8
from datagen.workers.rendering import Camera, Frame, Pixels, pixel_directions

PixelCaster = Callable[[npt.NDArray[np.int64]], Pixels]
_BLOCK = 8192  # pixels cast at once: colours depend on it in their last bits
_WINDOW_BLOCK = 2048  # of those around the target, of which the first few hundred mostly suffice


@dataclass(frozen=True, eq=False)
class Cloud:
    """P rows of which the first n hold points, in world axes with the origin at the target."""

    points_m: npt.NDArray[np.float16]  # (P, 3)
    rgb: U8  # (P, 3)
    target_mask: npt.NDArray[np.bool_]  # (P,)
    n: int


def caster_of(frame: Frame) -> PixelCaster:
    """A caster that looks pixels up in a finished frame."""
    rgb, depth_m, body = frame.rgb.reshape(-1, 3), frame.depth_m.ravel(), frame.body.ravel()
    return lambda pixels: Pixels(rgb[pixels], depth_m[pixels], body[pixels])


def target_pixels(camera: Camera, centre_m: F64, radius_m: float) -> npt.NDArray[np.int64]:
    """Flat indices of the pixels in the square that bounds the target's sphere."""
    rel = camera.T_world_camera[:3, :3].T @ (centre_m - camera.T_world_camera[:3, 3])
    depth_m = max(float(rel[2]), radius_m * 1.01)
    half = radius_m / np.sqrt(max(depth_m**2 - radius_m**2, 1e-12))
    u = camera.fx_px * (rel[0] / depth_m + np.array([-half, half])) + camera.cx_px
    v = camera.fy_px * (rel[1] / depth_m + np.array([-half, half])) + camera.cy_px
    columns = np.arange(max(int(u[0]), 0), min(int(u[1]) + 1, camera.width_px))
    rows = np.arange(max(int(v[0]), 0), min(int(v[1]) + 1, camera.height_px))
    return (rows[:, None] * camera.width_px + columns).ravel()


def observe_cloud(
    cast: PixelCaster,
    camera: Camera,
    target_body: int,
    centre_m: F64,
    radius_m: float,
    params: ObservationParams,
    rng: np.random.Generator,
) -> Cloud:
    """A random sample of the frame's points within `crop_radius_m` of the target.

    Pixels are drawn in random order without repetition; up to `min_target_points` of the target
    come first, so that a small target is never lost in the crop. Only the pixels drawn are cast.
    The first `n_farthest` stored points are in farthest-point order, so that any prefix of them is
    a farthest-point sample.
    """
    window = rng.permutation(target_pixels(camera, centre_m, radius_m))
    order = rng.permutation(camera.width_px * camera.height_px)
    sure = window[:0]
    for start in range(0, len(window), _WINDOW_BLOCK):
        block = window[start : start + _WINDOW_BLOCK]
        sure = np.append(sure, block[cast(block).body == target_body])
        if len(sure) >= params.min_target_points:
            break
    sure = sure[: params.min_target_points]
    fresh = np.ones(len(order), np.bool_)
    fresh[sure] = False

    points, colours, masks, count = [], [], [], 0
    for start in range(-_BLOCK, len(order), _BLOCK):
        if count >= params.n_points:
            break
        block = order[start : start + _BLOCK] if start >= 0 else sure
        pixels = block[fresh[block]] if start >= 0 else sure
        values = cast(pixels)
        rel = _points(camera, pixels, values.depth_m, centre_m)
        near = (values.depth_m > 0) & (np.einsum("ij,ij->i", rel, rel) <= params.crop_radius_m**2)
        points.append(rel[near])
        colours.append(values.rgb[near])
        masks.append(values.body[near] == target_body)
        count += int(near.sum())

    return stored_cloud(np.concatenate(points), np.concatenate(colours), np.concatenate(masks), params)


def stored_cloud(
    points_m: F32, rgb: U8, target_mask: npt.NDArray[np.bool_], params: ObservationParams
) -> Cloud:
    """The first `n_points` of points (N, 3) around the target, as a scene stores them.

    `n_farthest` of them come first, in farthest-point order; the others keep the order they came in.
    """
    n, size = min(len(points_m), params.n_points), params.n_points
    first = farthest_points(points_m[:n], min(params.n_farthest, n))
    rest = np.ones(n, np.bool_)
    rest[first] = False
    rows = np.concatenate([first, np.flatnonzero(rest)])
    cloud = Cloud(np.zeros((size, 3), np.float16), np.zeros((size, 3), np.uint8), np.zeros(size, np.bool_), n)
    cloud.points_m[:n] = points_m[rows]
    cloud.rgb[:n] = rgb[rows]
    cloud.target_mask[:n] = target_mask[rows]
    return cloud


def _points(camera: Camera, pixels: npt.NDArray[np.int64], depth_m: F32, centre_m: F64) -> F32:
    """Back-projection: points (N, 3) in world axes relative to the target."""
    T = camera.T_world_camera
    local = pixel_directions(camera, pixels) * depth_m[:, None]
    points = local @ T[:3, :3].T.astype(np.float32) + (T[:3, 3] - centre_m).astype(np.float32)
    return points.astype(np.float32, copy=False)


def farthest_points(points_m: F32, count: int) -> npt.NDArray[np.int64]:
    """Indices (count,) of a farthest-point sample that begins with the first point (Gonzalez 1985)."""
    chosen = np.zeros(count, np.int64)
    if count == 0:
        return chosen
    # One array per axis: three passes over contiguous memory beat one over rows of three.
    x, y, z = (np.ascontiguousarray(points_m[:, k], np.float32) for k in range(3))
    gap2 = np.full(len(points_m), np.inf, np.float32)
    dx, dy, dz = np.empty_like(x), np.empty_like(x), np.empty_like(x)
    for row in range(1, count):
        last = chosen[row - 1]
        gap2[last] = -1.0  # never chosen again, even if all remaining points equal a chosen one
        np.subtract(x, x[last], out=dx)
        np.subtract(y, y[last], out=dy)
        np.subtract(z, z[last], out=dz)
        np.multiply(dx, dx, out=dx)
        np.multiply(dy, dy, out=dy)
        np.multiply(dz, dz, out=dz)
        np.add(dx, dy, out=dx)
        np.add(dx, dz, out=dx)
        np.minimum(gap2, dx, out=gap2)
        chosen[row] = gap2.argmax()
    return chosen

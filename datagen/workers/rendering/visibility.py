"""rho: the visible share of the target from a camera, compared with the target alone."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F32, F64, transformed
from datagen.workers.geometry.transforms import look_at
from datagen.workers.rendering.embree import MISS, RayMesh, RayScene, nearest, occluded

# Occluders within this depth before a hit on the target are ignored, so that rounding does not let the
# target's support hide it.
_SKIN_M = 5e-4
# Rays in flight at once; bounds memory at about 25 MB. Far more rays do not fit the cache.
_MAX_RAYS = 1 << 16
# Directions in which the image of the target is bounded, and what is added to it against rounding.
_SLOPES = (-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0)
_SLACK = 1e-3

I32 = npt.NDArray[np.int32]
Counts = npt.NDArray[np.int64]


def visible_pixels(scene: RayScene, target: int, eyes_m: F64, window: int) -> tuple[I32, I32]:
    """Numbers (N,) of pixels that show the target alone, and of these that show it in the full scene.

    Each eye (N, 3), world, looks at the centre of object `target` through a window of
    `window` x `window` pixels that touches the target's bounding sphere, so that the ratio of the
    two does not depend on image size. An eye inside that sphere sees nothing: (0, 0).
    """
    n = len(eyes_m)
    target_px, visible_px = np.zeros(n, np.int32), np.zeros(n, np.int32)
    centre_m = scene.T_world_object[target, :3, 3]
    distance_m = np.linalg.norm(eyes_m - centre_m, axis=1)
    usable = np.flatnonzero(distance_m > scene.radii_m[target] * 1.05)
    block = max(1, _MAX_RAYS // window**2)
    for start in range(0, len(usable), block):
        rows = usable[start : start + block]
        alone, seen = _count(scene, target, eyes_m[rows], distance_m[rows], window)
        target_px[rows], visible_px[rows] = alone, seen
    return target_px, visible_px


def _count(scene: RayScene, target: int, eyes_m: F64, distance_m: F64, window: int) -> tuple[I32, I32]:
    n = len(eyes_m)
    T_world_target = scene.T_world_object[target]
    axes = look_at(eyes_m, T_world_target[:3, 3])[:, :3, :3]
    sine = scene.radii_m[target] / distance_m
    half_width = sine / np.sqrt(1 - sine**2)  # half of the window at depth 1
    per_eye, x, y = _window_rays(scene.objects[target], T_world_target, eyes_m, axes, half_width, window)

    # Alone, in the target's own frame.
    local_axes = T_world_target[:3, :3].T @ axes
    local_eyes = ((eyes_m - T_world_target[:3, 3]) @ T_world_target[:3, :3]).astype(np.float32)
    towards = _directions(local_axes, per_eye, x, y)
    parameter = nearest(scene.objects[target], _repeated(local_eyes, per_eye), towards)
    hit = np.flatnonzero(parameter < MISS)
    eye, limits = np.repeat(np.arange(n), per_eye)[hit], parameter[hit] - np.float32(_SKIN_M)
    alone = np.bincount(eye, minlength=n)
    directions = _directions(axes, alone, x[hit], y[hit])

    # The rays that neither the house nor another object in front of the target blocks.
    free = ~occluded(scene.house, _repeated(eyes_m.astype(np.float32), alone), directions, limits)
    for k in range(len(scene.objects)):
        if k == target:
            continue
        between = np.flatnonzero(np.repeat(_may_hide(scene, k, target, eyes_m, distance_m), alone) & free)
        if len(between):
            T = scene.T_world_object[k]
            local = ((eyes_m - T[:3, 3]) @ T[:3, :3]).astype(np.float32)
            towards = directions.take(between, axis=0) @ T[:3, :3].astype(np.float32)
            origins_m = _repeated(local, np.bincount(eye[between], minlength=n))
            free[between] = ~occluded(scene.objects[k], origins_m, towards, limits.take(between))
    return alone.astype(np.int32), np.bincount(eye[free], minlength=n).astype(np.int32)


def _repeated(points_m: F32, per_eye: Counts) -> F32:
    """Each point (n, 3) as often as `per_eye` (n,) says, (R, 3); repeating triples is far slower."""
    return np.repeat(points_m.T, per_eye, axis=1).T


def _directions(axes: F64, per_eye: Counts, x: F32, y: F32) -> F32:
    """Rays (R, 3) at depth 1 through x, y (R,), `per_eye` (n,) a camera; `axes` (n, 3, 3) are columns."""
    axes32 = axes.astype(np.float32)
    directions = np.empty((len(x), 3), np.float32)
    for row in range(3):
        right, down, forward = np.repeat(axes32[:, row].T, per_eye, axis=1)
        directions[:, row] = right * x + down * y + forward
    return directions


def _window_rays(
    target: RayMesh, T_world_target: F64, eyes_m: F64, axes: F64, half_width: F64, window: int
) -> tuple[Counts, F32, F32]:
    """The window's pixels that may show the target: numbers (n,) per eye, x, y at depth 1 (R,), camera frame.

    A pixel outside the image of a polyhedron around the target cannot show it; leaving it out changes
    no count and saves most rays of a long thin target.
    """
    corners_m = transformed(target.around_m, T_world_target)  # (K, 3)
    rel = (corners_m - eyes_m[:, None]) @ axes  # (n, K, 3)
    # A corner level with the eye or behind it has no image: then the whole window is cast.
    ahead = (rel[..., 2] > 1e-3).all(1)
    image = rel[..., :2] / (np.maximum(rel[..., 2:], 1e-3) * half_width[:, None, None])
    centres = (np.arange(window, dtype=np.float64) + 0.5) / window * 2 - 1
    # First and last position along each row (n, window), by the extents of x + slope y in the image.
    first, last = np.full((len(eyes_m), window), -1.0), np.full((len(eyes_m), window), 1.0)
    for slope in _SLOPES:
        across = image[..., 0] + slope * image[..., 1]
        first = np.maximum(first, across.min(1)[:, None] - slope * centres)
        last = np.minimum(last, across.max(1)[:, None] - slope * centres)
    y = image[..., 1, None]
    last[(centres < y.min(1) - _SLACK) | (centres > y.max(1) + _SLACK)] = -np.inf
    first[~ahead], last[~ahead] = -1.0, 1.0
    pixels = (centres >= first[..., None] - _SLACK) & (centres <= last[..., None] + _SLACK)
    per_eye, (_, v, u) = np.count_nonzero(pixels, axis=(1, 2)), np.nonzero(pixels)
    scale = np.repeat(half_width, per_eye)
    return per_eye, (centres[u] * scale).astype(np.float32), (centres[v] * scale).astype(np.float32)


def _may_hide(scene: RayScene, k: int, target: int, eyes_m: F64, distance_m: F64) -> npt.NDArray[np.bool_]:
    """Whether object k's bounding sphere cuts the capsule around the sight line; per eye (N,)."""
    centre_m = scene.T_world_object[target, :3, 3]
    along = (centre_m - eyes_m) / distance_m[:, None]
    rel = scene.T_world_object[k, :3, 3] - eyes_m
    t = np.clip((rel * along).sum(1), 0.0, distance_m)
    gap = np.linalg.norm(rel - t[:, None] * along, axis=1)
    # The window's rays to the target stay within its sphere's radius of the sight line.
    return gap < scene.radii_m[k] + scene.radii_m[target]

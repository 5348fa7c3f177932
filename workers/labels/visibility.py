"""rho: how much of the target a camera sees of what it would see without anything in between."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from workers.geometry.mesh import F32, F64
from workers.geometry.transforms import look_at
from workers.rendering.rays import MISS, RayStage, nearest, occluded

# A hit on the target counts as seen up to this depth before it, so that what the target stands on
# does not hide it by rounding.
_SKIN_M = 5e-4
# Rays in flight at once; bounds memory at about 100 MB.
_MAX_RAYS = 1 << 18

I32 = npt.NDArray[np.int32]


def window_directions(window: int) -> F32:
    """Homogeneous image directions (window^2, 3) of a square of half width 1 at depth 1."""
    axis = (np.arange(window, dtype=np.float64) + 0.5) / window * 2 - 1
    v, u = np.meshgrid(axis, axis, indexing="ij")
    return np.stack([u.ravel(), v.ravel(), np.ones(window * window)], axis=1).astype(np.float32)


def visible_pixels(stage: RayStage, target: int, eyes_m: F64, window: int) -> tuple[I32, I32]:
    """Pixels (N,) on the target when alone, and of them those that show it in the full scene.

    Each eye (N, 3), world, looks at the centre of object `target` through a window of
    `window` x `window` pixels that touches the target's bounding sphere, so that the share of the
    two does not depend on image size. An eye inside that sphere sees nothing: (0, 0).
    """
    n = len(eyes_m)
    target_px, visible_px = np.zeros(n, np.int32), np.zeros(n, np.int32)
    centre_m = stage.T_world_object[target, :3, 3]
    distance_m = np.linalg.norm(eyes_m - centre_m, axis=1)
    usable = np.flatnonzero(distance_m > stage.radii_m[target] * 1.05)
    block = max(1, _MAX_RAYS // window**2)
    for start in range(0, len(usable), block):
        rows = usable[start : start + block]
        alone, seen = _count(stage, target, eyes_m[rows], distance_m[rows], window)
        target_px[rows], visible_px[rows] = alone, seen
    return target_px, visible_px


def _count(stage: RayStage, target: int, eyes_m: F64, distance_m: F64, window: int) -> tuple[I32, I32]:
    n, rays = len(eyes_m), window * window
    T_world_target = stage.T_world_object[target]
    centre_m = T_world_target[:3, 3]
    sine = stage.radii_m[target] / distance_m
    tangent = sine / np.sqrt(1 - sine**2)  # half width of the window at depth 1
    axes = np.stack([look_at(eye, centre_m)[:3, :3] for eye in eyes_m])  # (n, 3, 3)
    axes[:, :, :2] *= tangent[:, None, None]
    directions = np.einsum("ri,nji->nrj", window_directions(window), axes.astype(np.float32))
    directions = np.ascontiguousarray(directions.reshape(-1, 3))

    # Alone, in the target's own frame.
    R = T_world_target[:3, :3].astype(np.float32)
    local_eyes = ((eyes_m - centre_m) @ T_world_target[:3, :3]).astype(np.float32)
    parameter = nearest(stage.objects[target], np.repeat(local_eyes, rays, axis=0), directions @ R)
    ray = np.flatnonzero(parameter < MISS)
    eye = ray // rays
    alone = np.bincount(eye, minlength=n).astype(np.int32)

    # What is left of these rays after the house and each other object that may stand before it.
    origins = eyes_m.astype(np.float32)
    directions, limits = directions[ray], parameter[ray] - np.float32(_SKIN_M)
    free = ~occluded(stage.house, origins[eye], directions, limits)
    for k in range(len(stage.objects)):
        if k == target:
            continue
        between = _may_hide(stage, k, target, eyes_m, distance_m)[eye] & free
        if between.any():
            T = stage.T_world_object[k]
            local = ((eyes_m - T[:3, 3]) @ T[:3, :3]).astype(np.float32)
            towards = directions[between] @ T[:3, :3].astype(np.float32)
            free[between] = ~occluded(stage.objects[k], local[eye[between]], towards, limits[between])
    return alone, np.bincount(eye[free], minlength=n).astype(np.int32)


def _may_hide(stage: RayStage, k: int, target: int, eyes_m: F64, distance_m: F64) -> npt.NDArray[np.bool_]:
    """Whether object k's bounding sphere cuts the capsule around the sight line; per eye (N,)."""
    centre_m = stage.T_world_object[target, :3, 3]
    along = (centre_m - eyes_m) / distance_m[:, None]
    rel = stage.T_world_object[k, :3, 3] - eyes_m
    t = np.clip((rel * along).sum(1), 0.0, distance_m)
    gap = np.linalg.norm(rel - t[:, None] * along, axis=1)
    # The window's rays to the target stay within its sphere's radius of the sight line.
    return gap < stage.radii_m[k] + stage.radii_m[target]

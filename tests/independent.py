"""A second, simple implementation of the heuristic label, written from the paper's text.

It shares no code with the package: meshes are rasterised triangle by triangle in double
precision, one camera at a time, and the formulas are spelled out again.
"""

from __future__ import annotations

import math

import numpy as np

SKIN_M = 5e-4


def camera_axes(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Rows: right, down, forward, of an upright camera."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-9:
        right = np.array([1.0, 0.0, 0.0])
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def depth_image(
    triangles: np.ndarray, eye: np.ndarray, axes: np.ndarray, half_width: float, window: int
) -> np.ndarray:
    """Depth (window, window) of the nearest triangle through each pixel centre; inf where none.

    `triangles` is (F, 3, 3), world; `half_width` is that of the image at depth 1.
    """
    depth = np.full(window * window, np.inf)
    local = (triangles - eye) @ axes.T
    local = local[(local[..., 2] > 0).any(1)]
    if len(local) == 0:
        return depth.reshape(window, window)
    whole = (local[..., 2] > 1e-6).all(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel = (local[..., :2] / local[..., 2:] / half_width + 1) / 2 * window - 0.5
    # A triangle that reaches behind the eye may appear anywhere.
    low = np.where(whole[:, None], np.ceil(np.nan_to_num(pixel.min(1)) - 1e-6), 0)
    high = np.where(whole[:, None], np.floor(np.nan_to_num(pixel.max(1)) + 1e-6), window - 1)
    low, high = np.clip(low, 0, window).astype(int), np.clip(high, -1, window - 1).astype(int)
    size = np.maximum(high - low + 1, 0)
    count = size[:, 0] * size[:, 1]
    for start in range(0, len(local), 20_000):
        part = slice(start, start + 20_000)
        face = np.repeat(np.arange(len(local))[part], count[part])
        if len(face) == 0:
            continue
        first = np.cumsum(count[part]) - count[part]
        offset = np.arange(len(face)) - np.repeat(first, count[part])
        u = low[face, 0] + offset % size[face, 0]
        v = low[face, 1] + offset // size[face, 0]
        x = ((u + 0.5) / window * 2 - 1) * half_width
        y = ((v + 0.5) / window * 2 - 1) * half_width
        ray = np.stack([x, y, np.ones(len(face))], axis=1)
        # Cramer's rule for t ray = a + s (b - a) + r (c - a): triple products, the face's part of them first.
        a, ab, ac = local[part, 0], local[part, 1] - local[part, 0], local[part, 2] - local[part, 0]
        normal, across, along = np.cross(ac, ab), np.cross(a, ac), np.cross(ab, a)
        determinant, over_s, over_r = (
            np.einsum("pk,pk->p", ray, each[face - start]) for each in (normal, across, along)
        )
        ok = np.abs(determinant) > 1e-18
        inverse = 1 / np.where(ok, determinant, 1)
        s, r = over_s * inverse, over_r * inverse
        t = (a * normal).sum(1)[face - start] * inverse
        hit = ok & (s >= 0) & (r >= 0) & (s + r <= 1) & (t > 0)
        np.minimum.at(depth, (v * window + u)[hit], t[hit])
    return depth.reshape(window, window)


def pixel_counts(
    target_triangles: np.ndarray,
    other_triangles: np.ndarray,
    center: np.ndarray,
    radius: float,
    eye: np.ndarray,
    window: int,
) -> tuple[int, int]:
    """(pixels on the target alone, pixels of it that show in the full scene)."""
    distance = float(np.linalg.norm(eye - center))
    if distance <= 1.05 * radius:
        return 0, 0
    half_width = math.tan(math.asin(radius / distance))
    axes = camera_axes(eye, center)
    target = depth_image(target_triangles, eye, axes, half_width, window)
    others = depth_image(other_triangles, eye, axes, half_width, window)
    alone = np.isfinite(target)
    return int(alone.sum()), int((alone & (others >= target - SKIN_M)).sum())


def score(d: float, rho: float) -> float:
    """H with the paper's numbers and this project's default mu and sigma."""
    if d < 0.14 or d > 0.92:
        near = 0.0
    else:
        near = math.exp(-((d - 0.53) ** 2) / (2 * 0.195**2))
    if rho < 0.04:
        seen = 0.05 + 6.25 * rho
    elif rho <= 0.8:
        seen = 0.3
    else:
        seen = 0.3 + 1.5 * (rho - 0.8)
    return 0.51 * seen + 0.49 * near

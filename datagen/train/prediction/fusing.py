"""Fuse frames into one world cloud, and make the model's input cloud of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from datagen.schemas.specification import ObservationParams
from datagen.train.inputs import F32, F64, U8, Bools
from datagen.train.prediction.frames import SensorFrame, moved
from datagen.train.prediction.ground import distances_m
from datagen.workers.rendering.cloud import Cloud, stored_cloud

VOXEL_M = 0.005
# Points of a frame without a mask are the target's if nearer than this to a known target point.
_JOINS_M = 0.008
_ROUNDS = 20


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """All points that the frames measured, world frame."""

    points_m: F32  # (N, 3)
    rgb: U8  # (N, 3)
    on_target: Bools  # (N,)
    eyes_m: F64  # (F, 3), where the cameras were; the first is the one that sees most of the target


def fuse(frames: Sequence[SensorFrame], poses: Sequence[F64]) -> SeenPoints:
    """One cloud of all frames, by their poses `T_world_camera`.

    Several frames keep one point per voxel: first a target's, then the nearest to its camera. A single frame
    keeps every point, so that it is sampled by pixels as in training.
    """
    worlds = [moved(f.points_m, T).astype(np.float32) for f, T in zip(frames, poses, strict=True)]
    points = np.concatenate(worlds)
    rgb = np.concatenate([f.rgb for f in frames])
    none = [np.zeros(len(f.points_m), np.bool_) if f.on_target is None else f.on_target for f in frames]
    on_target = np.concatenate(none)
    best = int(np.argmax([marks.sum() for marks in none]))
    eyes_m = np.array([T[:3, 3] for T in poses])
    eyes_m = np.concatenate([eyes_m[best : best + 1], np.delete(eyes_m, best, axis=0)])
    if len(frames) == 1:
        return SeenPoints(points, rgb, on_target, eyes_m)
    gap_m = np.concatenate([np.linalg.norm(w - T[:3, 3], axis=1) for w, T in zip(worlds, poses, strict=True)])
    order = np.lexsort([gap_m, ~on_target])
    cells = np.floor(points[order] / VOXEL_M).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    rows = np.sort(order[first])
    return SeenPoints(points[rows], rgb[rows], on_target[rows], eyes_m)


def join_target(seen: SeenPoints, center_m: F64, radius_m: float, support_m: float) -> SeenPoints:
    """The cloud with target marks extended to connected points above the support."""
    free = (np.linalg.norm(seen.points_m - center_m, axis=1) < 1.1 * radius_m) & ~seen.on_target
    free &= seen.points_m[:, 2] > support_m + 0.008
    rows, marked = np.flatnonzero(free), seen.on_target.copy()
    edge = np.flatnonzero(marked)
    for _ in range(_ROUNDS):
        if not len(rows) or not len(edge):
            break
        gaps, _nearest = KDTree(seen.points_m[edge]).query(seen.points_m[rows], distance_upper_bound=_JOINS_M)
        joins = np.isfinite(gaps)
        edge = rows[joins]
        marked[edge] = True
        rows = rows[~joins]
    return SeenPoints(seen.points_m, seen.rgb, marked, seen.eyes_m)


def crop_cloud(seen: SeenPoints, center_m: F64, params: ObservationParams, rng: np.random.Generator) -> Cloud:
    """The cloud around the target as scenes store it (`datagen.workers.rendering.cloud.observe_cloud`).

    Within the crop radius, up to `min_target_points` of the target first, then all in random order
    without repetition; the first stored ones are a farthest-point sample.
    """
    near = np.flatnonzero(distances_m(seen.points_m, center_m) <= params.crop_radius_m)
    sure = rng.permutation(near[seen.on_target[near]])[: params.min_target_points]
    fresh = np.ones(len(seen.points_m), np.bool_)
    fresh[sure] = False
    rows = np.concatenate([sure, (order := rng.permutation(near))[fresh[order]]])[: params.n_points]
    rel_m = (seen.points_m[rows].astype(np.float64) - center_m).astype(np.float32)
    return stored_cloud(rel_m, seen.rgb[rows], seen.on_target[rows], params)

"""How merged convex parts differ from the parts that they were made from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import ConvexHull

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.objects.hulls import distances_m, extent_m, hull_of, surface_points_m


def error_m(parts_m: Sequence[F32], merged_m: Sequence[F32]) -> float:
    """Largest distance from a point of the merged surfaces to the union of the original parts.

    Both are sampled 1/128 of the longest side apart: it may be 0.8 of that too large or too small.
    """
    originals = [hull_of(part) for part in parts_m]
    step_m = extent_m(originals) / 128
    points = np.concatenate([surface_points_m(hull_of(part), step_m) for part in merged_m])
    return float(distances_m(originals, points, step_m).max())


def added_volume_share(parts_m: Sequence[F32], merged_m: Sequence[F32]) -> float:
    """Sum over the merged parts by that over the original ones, less 1."""
    before, after = (sum(hull_of(part).volume_m3 for part in parts) for parts in (parts_m, merged_m))
    return after / before - 1


def farthest_outside_m(points: F64, parts_m: Sequence[F32]) -> float:
    """How far a point lies beyond the faces of the part that comes nearest to holding it.

    A face that cuts a point off is nearer to it than the nearest point of the part.
    """
    beyond = np.full(len(points), np.inf)
    for part in parts_m:
        planes = ConvexHull(part.astype(np.float64)).equations
        beyond = np.minimum(beyond, (points @ planes[:, :3].T + planes[:, 3]).max(axis=1))
    return float(beyond.max())


def cut_off_m(parts_m: Sequence[F32], merged_m: Sequence[F32]) -> float:
    """How far an original vertex lies outside the merged parts."""
    return farthest_outside_m(np.concatenate(parts_m).astype(np.float64), merged_m)

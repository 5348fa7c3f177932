"""Clearance of a base in the observed cloud, in place of the true map, which no robot has."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from datagen.schemas.specification import CandidateParams
from datagen.train.inputs import F64, Array, Batch

# Lower points are floor, within the error of a depth camera.
_FLOOR_M = 0.05
# Clearances are capped here: the cloud ends a metre around the target.
FAR_M = 1.0
_BASES = CandidateParams(scaled_base=True)  # as in `datagen predict`


def observed_clearance_m(batch: Batch[Array]) -> F64:
    """Horizontal distance (N,) from each base to the nearest observed obstacle (m), at most `FAR_M`.

    Negative where a point lies inside the base. Obstacles are points above the floor and below the arm's
    mount. Unobserved space is free.
    """
    clouds, robots = batch.clouds, batch.robots
    clearance = np.full(len(batch), FAR_M)
    order = np.argsort(batch.candidates.robot_row, kind="stable")
    ends = np.searchsorted(batch.candidates.robot_row[order], np.arange(len(robots) + 1))
    for robot in np.flatnonzero(np.diff(ends)):
        rows, cloud = order[ends[robot] : ends[robot + 1]], int(robots.cloud_row[robot])
        points_m = clouds.points_m[cloud, : int(clouds.n_points[cloud])].astype(np.float64)
        height_m = points_m[:, 2] + clouds.target_height_m[cloud]
        # Points that are not finite fail the comparisons.
        low = (height_m > _FLOOR_M) & (height_m < robots.base_height_m[robot])
        if not low.any():
            continue
        radius_m = float(_BASES.radius_of_base_m(float(robots.arm_reach_m[robot])))
        away_m, _ = KDTree(points_m[low, :2]).query(batch.candidates.base_xy_m[rows].astype(np.float64))
        clearance[rows] = np.minimum(away_m - radius_m, FAR_M)
    return clearance

"""Baseline: inverse reachability, over the directions of approach that the observed cloud leaves free.

Vahrenkamp, Asfour and Dillmann 2013, "Robot placement based on reachability inversion" (ICRA), invert an
arm's reachability map to rate base poses for a pose of the hand; Makhal and Goins 2018, "Reuleaux: robot base
placement by reachability analysis" (IRC), average over the poses of a task: here all free approaches.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from datagen.schemas.errors import InputError
from datagen.train.baselines.baseline import planar_distance_m, refitted_cut
from datagen.train.baselines.reachability_map import (
    AZIMUTHS,
    ReachabilityMap,
    free_approaches,
    part_directions,
    reachability_map,
)
from datagen.train.inputs import F32, F64, Array, Batch, Bools, is_clear
from datagen.workers.robots import ROBOTS, robot_limits

_SAME_REACH_M = 0.0015
_AT_ONCE = 4096  # candidates: bounds memory


@dataclass(frozen=True, eq=False)
class Reachability:
    """Score: the share of the free directions of approach from which the arm reaches the target's centre.

    It is -1 where the base is not clear, and 0 where no direction is free. Positive from `threshold` on,
    which `fit` sets for the best balanced accuracy of clear candidates. An arm is found among `robots` by its
    reach, first among arms of fixed size, then among scaled ones.
    """

    robots: tuple[str, ...] = tuple(ROBOTS)
    threshold: float = 0.27  # on 3,000 planned labels in validation houses
    name = "reachability"
    needs_fit = False

    def score(self, batch: Batch[Array]) -> F64:
        """Shares (N,). InputError where no robot has the reach of an arm, or a robot's files are missing."""
        robots, candidates = batch.robots, batch.candidates
        share = np.full(len(batch), -1.0)
        clear = is_clear(batch)
        planar_m = planar_distance_m(batch)
        xy_m = candidates.base_xy_m.astype(np.float64)
        heading_rad = np.arctan2(-xy_m[:, 1], -xy_m[:, 0])
        rise_m = batch.clouds.target_height_m[robots.cloud_row] - robots.base_height_m.astype(np.float64)
        free: dict[tuple[int, str], Bools] = {}
        for robot in np.unique(candidates.robot_row[clear]):
            reach_m, cloud = float(robots.arm_reach_m[robot]), int(robots.cloud_row[robot])
            reachable = reachability_map(self._robot_of(reach_m), reach_m)
            key = cloud, reachable.gripper.digest
            if key not in free:
                free[key] = _free(batch, cloud, reachable)
            rows = np.flatnonzero(clear & (candidates.robot_row == robot))
            for some in np.split(rows, range(_AT_ONCE, len(rows), _AT_ONCE)):
                height = np.full(len(some), rise_m[robot] / reach_m)
                found = reachable.at(planar_m[some] / reach_m, height)
                turned = _turned(free[key], heading_rad[some])
                share[some] = (found * turned).sum((1, 2)) / max(int(free[key].sum()), 1)
        return share

    def fit(self, batches: Sequence[Batch[Array]]) -> Reachability:
        """A copy with the best cut; unchanged where all clear candidates have the same label."""
        return replace(self, threshold=refitted_cut(self, batches, self.threshold))

    def state(self) -> dict[str, Any]:
        return {"robots": list(self.robots), "threshold": self.threshold}

    def _robot_of(self, reach_m: float) -> str:
        limits = dict[str, tuple[float, float]]()
        for name in self.robots:
            with suppress(InputError):  # its files are not installed here
                limits[name] = robot_limits(name).reach_m
        for name, (low, high) in sorted(limits.items(), key=lambda item: item[1][1] - item[1][0]):
            if low - _SAME_REACH_M <= reach_m <= high + _SAME_REACH_M:
                return name
        problem = f"none of {', '.join(self.robots)} has the reach {reach_m:.3f} m"
        raise InputError(
            "baseline reachability", "robots", problem, "Evaluate runs of robots of the registry"
        )


def _free(batch: Batch[Array], cloud: int, reachable: ReachabilityMap) -> Bools:
    clouds, n = batch.clouds, int(batch.clouds.n_points[cloud])
    others_m = clouds.points_m[cloud, :n][~clouds.target_mask[cloud, :n]]
    return free_approaches(others_m, part_directions(), reachable.gripper)


def _turned(free: Bools, heading_rad: F64) -> F32:
    """Free directions (LEVELS, AZIMUTHS) of the world as (N, LEVELS, AZIMUTHS) seen along headings (N,).

    Between two parts the share is linear.
    """
    shift = heading_rad / (2 * np.pi) % 1 * AZIMUTHS
    whole = np.floor(shift).astype(np.int64)
    part: F32 = (shift - whole).astype(np.float32)[:, None, None]
    column = (np.arange(AZIMUTHS) + whole[:, None]) % AZIMUTHS
    table = free.astype(np.float32).T
    lower: F32 = table[column].transpose(0, 2, 1)
    upper: F32 = table[(column + 1) % AZIMUTHS].transpose(0, 2, 1)
    return np.asarray(lower + part * (upper - lower), np.float32)

"""Random joint vectors of an arm with the hand poses they lead to: where to look for inverse kinematics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from datagen.workers.geometry.mesh import F64
from datagen.workers.motion.collision import Ints
from datagen.workers.motion.forward_kinematics import ForwardKinematics
from datagen.workers.robots.robot import Robot

_SAMPLES = 16384
_PROBES = 1024
# Poses further from all samples than this share of reachable ones are not asked for.
_QUANTILE = 0.97
_METRES_PER_UNIT = 0.25  # weight of a unit difference of directions beside positions


@dataclass(frozen=True, eq=False)
class ReachTable:
    """Samples by hand pose. Where the first joint turns about the mount's z axis, poses are compared after
    turning the hand to the front, so that this joint need not be sampled.
    """

    q_rad: F64  # (N, A)
    azimuth_rad: F64  # (N,), by which the hand was turned back to the front
    tree: Any
    turns: bool
    limit_m: float  # reachable poses are nearly all nearer than this to a sample
    lower_rad: F64  # (A,)
    upper_rad: F64  # (A,)

    def nearest(self, T_base_tcp: F64, count: int) -> tuple[F64, F64]:
        """Distances (G,) of the nearest sample, and the nearest `count` as seeds (G, count, A).

        Beyond the limit distances are infinite and seeds are of no use.
        """
        features, azimuth = _features(T_base_tcp, self.turns)
        ranks = list(range(1, count + 1))
        distance, row = self.tree.query(features, k=ranks, distance_upper_bound=self.limit_m)
        row = np.where(np.isfinite(distance), row, row[:, :1]) % len(self.q_rad)
        seeds = self.q_rad[row]
        if self.turns:
            seeds[:, :, 0] += azimuth[:, None] - self.azimuth_rad[row]
            seeds[:, :, 0] = (seeds[:, :, 0] + np.pi) % (2 * np.pi) - np.pi
        return distance[:, 0], np.clip(seeds, self.lower_rad, self.upper_rad)


def reach_table(robot: Robot, kinematics: ForwardKinematics, draw: int = 0) -> ReachTable:
    """The table of a robot; equal robots have equal tables."""
    rng = np.random.Generator(np.random.PCG64(draw))
    lower = np.maximum(robot.q_lower_rad, -np.pi)
    upper = np.minimum(robot.q_upper_rad, np.pi)
    q = rng.uniform(lower, upper, (_SAMPLES + _PROBES, len(lower)))
    axis = kinematics.first[0, :3, :3]  # the cross product with the first joint's axis
    turns = bool(
        kinematics.turns[0] and abs(axis[1, 0] - 1) < 1e-6 and np.abs(kinematics.first[0, :2, 3]).max() < 1e-6
    )
    features, azimuth = _features(kinematics.tcp(q), turns)
    tree = KDTree(features[:_SAMPLES])
    gaps, _ = tree.query(features[_SAMPLES:])
    return ReachTable(
        q[:_SAMPLES], azimuth[:_SAMPLES], tree, turns, float(np.quantile(gaps, _QUANTILE)), lower, upper
    )


def _features(T_base_tcp: F64, turns: bool) -> tuple[F64, F64]:
    """Position, approach and closing axis as (G, 9), and the azimuth (G,) they were turned back by."""
    p, R = T_base_tcp[:, :3, 3], T_base_tcp[:, :3, :3]
    azimuth = np.arctan2(p[:, 1], p[:, 0]) if turns else np.zeros(len(p))
    c, s = np.cos(azimuth), np.sin(azimuth)
    vectors = np.stack([p, R[:, :, 2] * _METRES_PER_UNIT, R[:, :, 1] * _METRES_PER_UNIT], axis=1)  # (G, 3, 3)
    x, y = vectors[..., 0], vectors[..., 1]
    turned = np.stack(
        [x * c[:, None] + y * s[:, None], y * c[:, None] - x * s[:, None], vectors[..., 2]], axis=2
    )
    return turned.reshape(len(p), 9), azimuth


def order_by_distance(distance_m: F64) -> Ints:
    """Rows at finite distances, nearest first."""
    rows = np.argsort(distance_m, kind="stable")
    return rows[np.isfinite(distance_m[rows])]

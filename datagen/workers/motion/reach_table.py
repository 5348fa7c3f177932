"""Random joint vectors of an arm and their hand poses, as seeds of inverse kinematics."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from datagen.workers.geometry.mesh import F64
from datagen.workers.motion.forward_kinematics import ForwardKinematics, Kinematics, TreeKinematics
from datagen.workers.robots.robot import Robot

_SAMPLES = 65536
_PROBES = 2048
# Inverse kinematics skips poses farther from all samples than this quantile of reachable poses.
_QUANTILE = 0.97
_LENGTHS_PER_UNIT = 0.25  # weight of a unit difference of directions, in arm lengths
_DISTANCE_EPS = 1.0  # largest relative error of the nearest distance: halves the time of a query
_SEED_EPS = 0.3  # the same for seeds
_PER_SEED = 6  # samples near a pose among which each of its seeds is chosen
_APART_RAD = 1.0  # seeds with all joints nearer than this often lead to one solution
_DIGITS = 6  # digits of an arm's numbers, in units of its length: scaled copies of an arm share samples


@dataclass(frozen=True, eq=False)
class _Samples:
    """Joint vectors by pose of the wrist, with the arm's length as unit: all scales of an arm share them.

    Where the first joint turns about the mount's z axis, poses are compared after turning the hand to the
    front, so that this joint need not be sampled.
    """

    q_rad: F64  # (N, A)
    azimuth_rad: F64  # (N,), by which the hand was turned back to the front
    tree: Any
    turns: bool
    limit: float  # reachable poses are nearly all nearer than this to a sample


@dataclass(frozen=True, eq=False)
class ReachTable:
    """The samples for one arm. Its wrist is the frame of the last link that no finger moves."""

    samples: _Samples
    length_m: float  # from the mount to the wrist with all joints at zero
    tcp_wrist_m: F64  # (3,), in the TCP frame
    lower_rad: F64  # (A,)
    upper_rad: F64  # (A,)

    @property
    def limit_m(self) -> float:
        """The limit in metres: a wrist that is farther from all reachable ones is beyond the limit."""
        return self.samples.limit * self.length_m

    def distance(self, T_base_tcp: F64) -> F64:
        """Distances (G,) of poses to an approximately nearest sample, in arm lengths.

        They are infinite beyond the limit, where inverse kinematics is not tried.
        """
        features, _ = self._features(T_base_tcp)
        tree, limit = self.samples.tree, self.samples.limit
        return tree.query(features, eps=_DISTANCE_EPS, distance_upper_bound=limit)[0]

    def seeds(self, T_base_tcp: F64, count: int) -> F64:
        """Joints (G, count, A) of samples near each pose that differ from each other.

        The first is the nearest. Each further one is the next of the `_PER_SEED * count` nearest that differs
        from those before by `_APART_RAD` in some joint, or where there is none the one that differs most.
        """
        features, azimuth = self._features(T_base_tcp)
        samples = self.samples
        row = samples.tree.query(features, k=list(range(1, _PER_SEED * count + 1)), eps=_SEED_EPS)[1]
        near = samples.q_rad[row]
        if samples.turns:
            near[:, :, 0] += azimuth[:, None] - samples.azimuth_rad[row]
            near[:, :, 0] = (near[:, :, 0] + np.pi) % (2 * np.pi) - np.pi
        near = np.clip(near, self.lower_rad, self.upper_rad)
        every, best = np.arange(len(near)), np.zeros(len(near), np.int64)
        gap = np.full(near.shape[:2], np.inf)
        seeds = np.empty((len(near), count, near.shape[2]))
        for k in range(count):
            seeds[:, k] = near[every, best]
            gap = np.minimum(gap, np.abs(near - seeds[:, k, None]).max(axis=2))
            best = np.minimum(gap, _APART_RAD).argmax(axis=1)
        return seeds

    def _features(self, T_base_tcp: F64) -> tuple[F64, F64]:
        wrist = (T_base_tcp[:, :3, :3] @ self.tcp_wrist_m + T_base_tcp[:, :3, 3]) / self.length_m
        return _features(wrist, T_base_tcp[:, :3, :3], self.samples.turns)


def reach_table(robot: Robot, kinematics: Kinematics, draw: int = 0) -> ReachTable:
    """The table of a robot; equal robots have equal tables. `draw` seeds its samples."""
    lower = np.maximum(robot.q_lower_rad, -np.pi)
    upper = np.minimum(robot.q_upper_rad, np.pi)
    T_tcp = kinematics.T_base_frame[-1]
    wrist_m = kinematics.T_base_frame[int(np.argmax(kinematics.depth == kinematics.depth[-1])), :3, 3]
    length_m = float(np.linalg.norm(wrist_m))

    def shared(T: F64) -> bytes:
        return (np.round(_with_unit(T, length_m), _DIGITS) + 0.0).tobytes()  # no negative zero

    if isinstance(kinematics, TreeKinematics):
        length_m = robot.reach_m
        q = _random(lower, upper, draw)
        poses = kinematics.tcp(q)
        tcp_wrist_m = T_tcp[:3, :3].T @ (wrist_m - T_tcp[:3, 3])
        poses[:, :3, 3] = (poses[:, :3, :3] @ tcp_wrist_m + poses[:, :3, 3]) / length_m
        return ReachTable(_sampled(q, poses, robot.presents == "turns"), length_m, tcp_wrist_m, lower, upper)
    T_wrist = T_tcp.copy()
    T_wrist[:3, 3] = wrist_m
    samples = _samples(
        shared(kinematics.first),
        shared(kinematics.second),
        shared(T_wrist),
        lower.tobytes(),
        upper.tobytes(),
        draw,
    )
    return ReachTable(samples, length_m, T_tcp[:3, :3].T @ (wrist_m - T_tcp[:3, 3]), lower, upper)


@lru_cache(maxsize=16)
def _samples(
    first: bytes,
    second: bytes,
    T_wrist: bytes,
    lower_rad: bytes,
    upper_rad: bytes,
    draw: int,
) -> _Samples:
    """Samples of an arm by its rounded numbers alone: the scale that is opened first does not matter."""
    P, S, T = (np.frombuffer(m).reshape(-1, 4, 4) for m in (first, second, T_wrist))
    kinematics = ForwardKinematics(P, S, T, np.array([len(P)]))
    q = _random(np.frombuffer(lower_rad), np.frombuffer(upper_rad), draw)
    axis = P[0, :3, :3]  # the cross product with the first joint's axis
    is_upright = bool(abs(axis[1, 0] - 1) < 1e-6 and np.abs(P[0, :2, 3]).max() < 1e-6)
    return _sampled(q, kinematics.tcp(q), is_upright)


def _random(lower: F64, upper: F64, draw: int) -> F64:
    rng = np.random.Generator(np.random.PCG64(draw))
    return rng.uniform(lower, upper, (_SAMPLES + _PROBES, len(lower)))


def _sampled(q: F64, poses: F64, is_upright: bool) -> _Samples:
    features, azimuth = _features(poses[:, :3, 3], poses[:, :3, :3], is_upright)
    tree = KDTree(features[:_SAMPLES])
    gaps, _ = tree.query(features[_SAMPLES:], eps=_DISTANCE_EPS)
    limit = float(np.quantile(gaps, _QUANTILE))
    return _Samples(q[:_SAMPLES], azimuth[:_SAMPLES], tree, is_upright, limit)


def _with_unit(T: F64, length_m: float) -> F64:
    """Matrices (..., 4, 4) with their translations in another unit."""
    out = T.copy()
    out[..., :3, 3] /= length_m
    return out


def _features(p: F64, R: F64, turns: bool) -> tuple[F64, F64]:
    """Position, approach and closing axis as (G, 9), and the azimuth (G,) they were turned back by.

    With `turns` (G, 8): the position's y is zero.
    """
    azimuth = np.arctan2(p[:, 1], p[:, 0]) if turns else np.zeros(len(p))
    c, s = np.cos(azimuth), np.sin(azimuth)
    vectors = np.stack(
        [p, R[:, :, 2] * _LENGTHS_PER_UNIT, R[:, :, 1] * _LENGTHS_PER_UNIT], axis=1
    )  # (G, 3, 3)
    x, y = vectors[..., 0], vectors[..., 1]
    turned = np.stack(
        [x * c[:, None] + y * s[:, None], y * c[:, None] - x * s[:, None], vectors[..., 2]], axis=2
    )
    features = turned.reshape(len(p), 9)
    return np.delete(features, 1, axis=1) if turns else features, azimuth

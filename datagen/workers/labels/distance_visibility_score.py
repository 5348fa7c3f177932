"""The distance-visibility score of a base pose (GBPP, Sec. III-B)."""

from __future__ import annotations

import numpy as np

from datagen.schemas.specification import HeuristicParams
from datagen.workers.geometry.mesh import F32, F64, U8

VERSION = 1


def distance_score(d: F64, params: HeuristicParams) -> F64:
    """Asymmetric Gaussian a exp(-(d - mu)^2 / (2 sigma^2)); 0 outside [d_min, d_max].

    sigma is sigma_l below mu and sigma_r from mu on.
    """
    sigma = np.where(d < params.mu, params.sigma_l, params.sigma_r)
    score = params.a * np.exp(-0.5 * ((d - params.mu) / sigma) ** 2)
    return np.where((d >= params.d_min) & (d <= params.d_max), score, 0.0)


def visibility_score(rho: F64) -> F64:
    """Piecewise linear in the visible share rho: steep near 0, flat in the middle, steep near 1."""
    return np.where(rho < 0.04, 0.05 + 6.25 * rho, np.where(rho <= 0.8, 0.3, 0.3 + 1.5 * (rho - 0.8)))


def effective_distance(
    distance_m: F32 | F64, mount_distance_m: F32 | F64, arm_reach_m: F32 | F64, params: HeuristicParams
) -> F64:
    """The distance that the score is a function of: the paper's planar one, or a reach-relative one."""
    match params.distance:
        case "planar":
            return distance_m.astype(np.float64)
        case "planar-over-reach":
            return distance_m.astype(np.float64) / arm_reach_m
        case "mount-over-reach":
            return mount_distance_m.astype(np.float64) / arm_reach_m


def heuristic(
    distance_m: F32, mount_distance_m: F32, arm_reach_m: F32, visibility: F32, params: HeuristicParams
) -> tuple[F32, U8]:
    """Score H = alpha visScore + (1 - alpha) distScore, and label H >= tau; all inputs (N,).

    The label is decided on the stored float32 inputs and score, so that a stored score and its
    label never disagree and both can be recomputed from the record.
    """
    d = effective_distance(distance_m, mount_distance_m, arm_reach_m, params)
    rho = visibility.astype(np.float64)
    score = params.alpha * visibility_score(rho) + (1 - params.alpha) * distance_score(d, params)
    score32 = score.astype(np.float32)
    return score32, (score32 >= np.float32(params.tau)).astype(np.uint8)

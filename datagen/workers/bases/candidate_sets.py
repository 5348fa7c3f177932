"""Candidate sets for statistics."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.schemas.specification import CandidateParams

Bools = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.floating[Any]]

# Narrowest first. On a whole grid most candidates are far away or inside furniture, which any rule gets
# right, so accuracy is meaningless without the set.
CANDIDATE_SETS = ("in-range", "clear", "grid")


def within_reach(params: CandidateParams, mount_distance_m: Floats, arm_reach_m: Floats) -> Bools:
    """Mask (N,) of a run's candidates within reach: all, where they were sampled from a reachable set."""
    if params.in_range_by is not None:
        return np.ones(len(mount_distance_m), np.bool_)
    return mount_distance_m <= arm_reach_m


def in_set(name: str, is_clear: Bools, is_reachable: Bools) -> Bools:
    """Mask (N,) of the candidates in a set of CANDIDATE_SETS: clear, clear and within reach, or all."""
    match name:
        case "in-range":
            return is_clear & is_reachable
        case "clear":
            return is_clear
        case _:
            return np.ones(len(is_clear), np.bool_)

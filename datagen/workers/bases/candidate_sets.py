"""Candidate sets for statistics, and bands of quantities to group by."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

Bools = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.floating[Any]]
Edges = Sequence[float | None]

# Narrowest first. On a whole grid most candidates are far away or inside furniture, which any rule gets
# right, so accuracy is meaningless without the set.
CANDIDATE_SETS = ("in-range", "clear", "grid")

TENTHS = tuple(round(0.1 * k, 1) for k in range(11))
DISTANCE_EDGES_M: Edges = (*TENTHS, None)
# Edges of the visibility score: hidden, partly visible, nearly free.
VISIBILITY_EDGES: Edges = (0.0, 0.04, 0.2, 0.4, 0.6, 0.8, None)


def in_set(name: str, is_clear: Bools, mount_distance_m: Floats, arm_reach_m: Floats) -> Bools:
    """Mask (N,) of the candidates in a set of CANDIDATE_SETS: clear, clear and within reach, or all."""
    match name:
        case "in-range":
            return is_clear & (mount_distance_m <= arm_reach_m)
        case "clear":
            return is_clear
        case _:
            return np.ones(len(is_clear), np.bool_)


def bands(values: Floats, edges: Edges) -> list[tuple[float, float | None, Bools]]:
    """Masks (N,) of each non-empty band [low, high); an edge None is unbounded."""
    found: list[tuple[float, float | None, Bools]] = []
    for low, high in pairwise(edges):
        assert low is not None
        # Stored numbers are float32: a reach of 0.7 m belongs to the band that begins at 0.7.
        inside = values >= np.float32(low)
        if high is not None:
            inside &= values < np.float32(high)
        if inside.any():
            found.append((low, high, inside))
    return found

"""RRT-Connect (Kuffner and LaValle 2000) over whole edges, its shortcuts, and straight lines in joint space.

It replaces ompl, whose Python interface accepts no sampler, has one random generator for the whole process,
and checks configurations one by one. Here an edge is checked as a whole.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from datagen.workers.geometry.mesh import F64

# The first of M configurations (M, A) that is in collision, or M where none is.
FirstBlocked = Callable[[F64], int]
_LONGEST_EDGE_RAD = 1.0
_FIRST_LOOK = 8  # stride of the first, coarse check of a long line


def straight(q_from: F64, q_to: F64, step_rad: float) -> F64:
    """Configurations (M, A) from one to the other, both included, evenly and at most `step_rad` apart."""
    count = max(1, int(np.ceil(np.linalg.norm(q_to - q_from) / step_rad - 1e-9)))
    q = q_from + np.linspace(0.0, 1.0, count + 1)[:, None] * (q_to - q_from)
    q[-1] = q_to  # to the bit, so that lines join
    return q


def dense(corners_rad: F64, step_rad: float) -> F64:
    """The polyline (K, A) through corners, as configurations (M, A) at most `step_rad` apart."""
    lines = [straight(a, b, step_rad)[1:] for a, b in pairwise(corners_rad)]
    return np.concatenate([corners_rad[:1], *lines])


def is_line_free(q_from: F64, q_to: F64, first_blocked: FirstBlocked, step_rad: float) -> bool:
    """Whether nothing on the straight line after `q_from` collides; checks a sparse subset first."""
    q = straight(q_from, q_to, step_rad)[1:]
    if len(q) > 2 * _FIRST_LOOK:
        sparse = np.zeros(len(q), np.bool_)
        sparse[_FIRST_LOOK // 2 :: _FIRST_LOOK] = True
        if first_blocked(q[sparse]) < sparse.sum():
            return False
        q = q[~sparse]
    return first_blocked(q) == len(q)


class _SearchTree:
    def __init__(self, root: F64, capacity: int) -> None:
        self.q = np.empty((capacity, len(root)))
        self.q[0] = root
        self.parent = [-1]

    def nearest(self, q: F64) -> int:
        return int(np.argmin(((self.q[: len(self.parent)] - q) ** 2).sum(axis=1)))

    def add(self, q: F64, parent: int) -> int:
        self.q[len(self.parent)] = q
        self.parent.append(parent)
        return len(self.parent) - 1

    def way_to(self, row: int) -> list[F64]:
        way: list[F64] = []
        while row >= 0:
            way.append(self.q[row])
            row = self.parent[row]
        return way[::-1]


def connect(
    q_start: F64,
    q_goal: F64,
    lower_rad: F64,
    upper_rad: F64,
    first_blocked: FirstBlocked,
    step_rad: float,
    iterations: int,
    rng: np.random.Generator,
) -> tuple[F64 | None, int]:
    """Corners (K, A) of a free path between two free configurations, and the number of samples used.

    The path is None after `iterations` samples.

    Each sample extends one tree by an edge of at most 1 rad towards it; the other tree then grows straight
    towards the new end as far as the line is free. The trees take turns. The same `rng` gives the same path.
    """
    capacity = 2 * iterations + 1
    trees = (_SearchTree(q_start, capacity), _SearchTree(q_goal, capacity))
    for k in range(iterations):
        grown, other = trees[k % 2], trees[1 - k % 2]
        end = _advance(grown, rng.uniform(lower_rad, upper_rad), _LONGEST_EDGE_RAD, first_blocked, step_rad)
        if end is None:
            continue
        met = _advance(other, grown.q[end], np.inf, first_blocked, step_rad)
        if met is not None and np.array_equal(other.q[met], grown.q[end]):
            ends = (end, met) if k % 2 == 0 else (met, end)
            there, back = trees[0].way_to(ends[0]), trees[1].way_to(ends[1])
            return np.array(there + back[:-1][::-1]), k + 1
    return None, iterations


def _advance(
    tree: _SearchTree, q_to: F64, longest_rad: float, first_blocked: FirstBlocked, step_rad: float
) -> int | None:
    """Grow from the nearest node towards `q_to` as far as the line is free; the new node, if any."""
    nearest = tree.nearest(q_to)
    q_from = tree.q[nearest]
    length = float(np.linalg.norm(q_to - q_from))
    if length == 0:
        return nearest
    whole = length <= longest_rad
    line = straight(q_from, q_to if whole else q_from + (q_to - q_from) * (longest_rad / length), step_rad)[
        1:
    ]
    if whole:
        line[-1] = q_to
    free = line[: first_blocked(line)]
    return tree.add(free[-1], nearest) if len(free) else None


def shortened(
    path_rad: F64, first_blocked: FirstBlocked, step_rad: float, tries: int, rng: np.random.Generator
) -> F64:
    """A dense path (M, A) with shortcuts: straight lines between random rows of it, where free.

    It is never longer than before, and every row is checked. The same `rng` gives the same path.
    """
    path = path_rad
    for _ in range(tries):
        i, j = np.sort(rng.integers(len(path), size=2)).tolist()
        way = float(np.linalg.norm(np.diff(path[i : j + 1], axis=0), axis=1).sum())
        is_shorter = np.linalg.norm(path[j] - path[i]) < way - step_rad / 10
        if is_shorter and is_line_free(path[i], path[j], first_blocked, step_rad):
            path = np.concatenate([path[:i], straight(path[i], path[j], step_rad), path[j + 1 :]])
    return path

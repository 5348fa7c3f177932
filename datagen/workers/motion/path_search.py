"""Paths to a pregrasp where the straight one is not free, compiled: RRT-Connect and shortcuts."""

from __future__ import annotations

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.kinematics.compiler import compiled
from datagen.workers.kinematics.inverse import one_turn, put, put_row
from datagen.workers.kinematics.tree import Ints
from datagen.workers.motion.arm_motion import Search, between, is_blocked, is_line_free, length, steps_on
from datagen.workers.motion.hand_motion import NOTHING

_SHORTCUTS = 20
_LONGEST_EDGE = 1.0


@compiled
def _grow(
    s: Search, opening: int, tree: F64, parent: Ints, n: int, q_to: F64, longest: float
) -> tuple[int, bool]:
    """Grow from the nearest node towards `q_to` while the line is free; the new size, and if it got there."""
    weight, at, least = s.arm.weight, 0, np.inf
    for k in range(n):
        far = length(weight, tree[k], q_to)
        if far < least:
            at, least = k, far
    end, q = np.empty(len(q_to)), np.empty(len(q_to))
    put_row(q_to, end)
    is_whole = least <= longest
    if not is_whole:
        for m in range(len(q_to)):
            end[m] = tree[at, m] + (q_to[m] - tree[at, m]) * (longest / least)
    steps, free = steps_on(weight, tree[at], end, s.limits.step), 0
    for k in range(1, steps + 1):
        between(tree[at], end, k, steps, q)
        if is_blocked(s, q, opening, NOTHING):
            break
        free = k
    if free == 0:
        return n, False
    between(tree[at], end, free, steps, tree[n])
    parent[n] = at
    return n + 1, is_whole and free == steps


@compiled
def connect(
    s: Search, opening: int, q_start: F64, q_goal: F64, iterations: int, rng: np.random.Generator
) -> tuple[F64, int]:
    """Corners (K, A) of a free path by RRT-Connect (Kuffner and LaValle 2000), and the samples used.

    K is 0 where none was found. Each sample extends one tree by an edge of at most 1 rad towards it; the
    other tree then grows straight towards the new end as far as the line is free. The trees take turns.
    """
    count = len(q_start)
    trees, parents = np.empty((2, 2 * iterations + 2, count)), np.empty((2, 2 * iterations + 2), np.int64)
    put_row(q_start, trees[0, 0])
    put_row(q_goal, trees[1, 0])
    parents[0, 0] = parents[1, 0] = -1
    sizes = np.ones(2, np.int64)
    sample, lower, upper = np.empty(count), s.arm.tree.lower, s.arm.tree.upper
    for k in range(iterations):
        for m in range(count):
            low, high = one_turn(lower[m], upper[m])
            sample[m] = low + (high - low) * rng.random()
        new = sizes[k % 2]
        for grown in range(2):
            t = (k + grown) % 2
            q_to, longest = (sample, _LONGEST_EDGE) if grown == 0 else (trees[1 - t, new], np.inf)
            before = sizes[t]
            sizes[t], is_there = _grow(s, opening, trees[t], parents[t], before, q_to, longest)
            if sizes[t] == before:
                break
            if grown == 1 and is_there:
                return _joined(trees, parents, sizes), k + 1
    return trees[0, :0], iterations


@compiled
def _joined(trees: F64, parents: Ints, sizes: Ints) -> F64:
    """The way from the first root to the second, through the last node of each tree, which are the same."""
    lengths = np.zeros(2, np.int64)
    for t in range(2):
        row = sizes[t] - 1
        while row >= 0:
            lengths[t] += 1
            row = parents[t, row]
    out = np.empty((lengths[0] + lengths[1] - 1, trees.shape[2]))
    row, at = sizes[0] - 1, lengths[0] - 1
    while row >= 0:
        put_row(trees[0, row], out[at])
        at -= 1
        row = parents[0, row]
    row, at = parents[1, sizes[1] - 1], lengths[0]
    while row >= 0:
        put_row(trees[1, row], out[at])
        at += 1
        row = parents[1, row]
    return out


@compiled
def dense(weight: F64, corners: F64, step: float) -> F64:
    """The polyline through corners (K, A), as coordinates (M, A) at most `step` radians apart."""
    total = 1
    for k in range(1, len(corners)):
        total += steps_on(weight, corners[k - 1], corners[k], step)
    out = np.empty((total, corners.shape[1]))
    put_row(corners[0], out[0])
    at = 1
    for k in range(1, len(corners)):
        n = steps_on(weight, corners[k - 1], corners[k], step)
        for i in range(1, n + 1):
            between(corners[k - 1], corners[k], i, n, out[at])
            at += 1
    return out


@compiled
def shortened(s: Search, opening: int, path: F64, rng: np.random.Generator) -> F64:
    """A dense path (M, A) with shortcuts: straight lines between random rows of it, where free."""
    weight, step = s.arm.weight, s.limits.step
    for _ in range(_SHORTCUTS):
        i, j = rng.integers(0, len(path)), rng.integers(0, len(path))
        if i > j:
            i, j = j, i
        way = 0.0
        for k in range(i, j):
            way += length(weight, path[k], path[k + 1])
        if length(weight, path[i], path[j]) >= way - step / 10:
            continue
        if is_line_free(s, path[i], path[j], opening, NOTHING):
            n = steps_on(weight, path[i], path[j], step)
            new = np.empty((i + 1 + n + len(path) - j - 1, path.shape[1]))
            put(path[: i + 1], new)
            for k in range(1, n + 1):
                between(path[i], path[j], k, n, new[i + k])
            put(path[j + 1 :], new[i + n + 1 :])
            path = new
    return path

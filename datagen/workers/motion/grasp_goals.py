"""Which grasps of a scene are tried from one base pose, and in which order."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.motion.collision import Bools, Ints
from datagen.workers.motion.grasp_filter import backed
from datagen.workers.motion.planning_scene import PlanningScene

_FIRST_BATCH, _LARGEST_BATCH = 2, 64  # grasps checked together
# Poses are sorted by distance in portions; each has this many more than all before it.
_FIRST_PORTION = 24
_FILTERED_AT_ONCE = 200


@dataclass(frozen=True, eq=False)
class Goal:
    """A kept grasp, seen from the base."""

    k: int
    T_base_tcp: F64  # (4, 4)
    seeds_rad: F64  # (S, A)
    limit: str  # furthest stage that it can reach


def goals_of(
    prepared: PlanningScene, T_base_world: F64, kept: Ints, rest: Ints, most: int
) -> Iterator[list[Goal]]:
    """At most `most` of the free poses `kept` and `rest` with seeds near by, in growing batches.

    `kept` come first, in portions of their order, in which neighbours differ much; in each portion, the poses
    nearest to a seed come first. `rest` are sorted by that distance as a whole.
    """
    table, left, batch = prepared.moving.table, most, _FIRST_BATCH
    for rows, portion in ((kept, _FIRST_PORTION), (rest, len(rest))):
        if left == 0:
            return
        T_base_tcp = np.matmul(T_base_world, prepared.around.T_world_tcp[rows])
        within = _is_within_reach(prepared, T_base_world, T_base_tcp)
        rows, T_base_tcp = rows[within], T_base_tcp[within]
        end = 0
        while left > 0 and end < len(rows):
            start, end = end, min(len(rows), 2 * end + portion)
            k, T = rows[start:end], T_base_tcp[start:end]
            near = _is_wrist_within_reach(prepared, T_base_world, T, table.limit_m).all(axis=0)
            k, T = k[near], T[near]
            nearest = _nearest_first(prepared, T_base_world, T, table.distance(T))
            # The hand's motion is checked for few at a time: most candidates need no more.
            while left > 0 and (some := list(islice(nearest, _FILTERED_AT_ONCE))):
                free = np.array(some)[prepared.around.is_free(k[some])][:left]
                left -= len(free)
                while len(free):
                    now, free = np.split(free, [batch])
                    seeds = table.seeds(T[now], prepared.params.ik_seeds)
                    limits = _limits(prepared, T_base_world, T[now])
                    yield list(map(Goal, k[now].tolist(), T[now], seeds, limits))
                    batch = min(2 * batch, _LARGEST_BATCH)


def _nearest_first(
    prepared: PlanningScene, T_base_world: F64, T_base_tcp: F64, distance: F64
) -> Iterator[int]:
    """Rows of the poses (G, 4, 4) with a sample near by, nearest first; `distance` (G,) is theirs.

    The pregrasp and the end of the lift need a sample near by too: the largest of the three distances counts.
    It is computed for few poses at a time, because it is never smaller than `distance`.
    """
    order = np.argsort(distance, kind="stable")[: int(np.isfinite(distance).sum())]
    waiting: list[tuple[float, int]] = []
    for start in range(0, len(order), _FILTERED_AT_ONCE):
        rows, later = np.split(order[start:], [_FILTERED_AT_ONCE])
        ends = np.concatenate(_line_ends(prepared, T_base_world, T_base_tcp[rows]))
        at_ends = prepared.moving.table.distance(ends).reshape(2, -1).max(axis=0)
        farthest = np.maximum(distance[rows], at_ends)
        waiting = sorted([*waiting, *zip(farthest.tolist(), rows.tolist(), strict=True)])
        bound = float(distance[later[0]]) if len(later) else np.inf
        ready = bisect_left(waiting, (bound, -1))
        yield from (row for _, row in waiting[:ready])
        waiting = waiting[ready:]


def _line_ends(prepared: PlanningScene, T_base_world: F64, T_base_tcp: F64) -> tuple[F64, F64]:
    """The pregrasp and the end of the lift (G, 4, 4) of each grasp."""
    T_lifted = T_base_tcp.copy()
    T_lifted[:, :3, 3] += prepared.params.lift_m * T_base_world[:3, 2]
    return backed(T_base_tcp, prepared.params.pregrasp_m), T_lifted


def _limits(prepared: PlanningScene, T_base_world: F64, T_base_tcp: F64) -> list[str]:
    """The furthest stage that each grasp (G, 4, 4) can reach, by the length of the arm up to its wrist."""
    grasp, pregrasp, lifted = _is_wrist_within_reach(prepared, T_base_world, T_base_tcp, 0.0)
    return np.where(grasp & pregrasp, np.where(lifted, "success", "no_lift"), "no_ik").tolist()


def _is_wrist_within_reach(
    prepared: PlanningScene, T_base_world: F64, T_base_tcp: F64, beyond_m: float
) -> Bools:
    """Whether the wrist is at most `beyond_m` beyond reach (3, G): at grasp, pregrasp and end of the lift."""
    poses = (T_base_tcp, *_line_ends(prepared, T_base_world, T_base_tcp))
    return np.array([prepared.robot.is_wrist_within_reach(T, beyond_m) for T in poses])


def _is_within_reach(prepared: PlanningScene, T_base_world: F64, T_base_tcp: F64) -> Bools:
    """Whether the TCP is within reach (G,) at the grasp, at the pregrasp and at the end of the lift."""
    robot, params = prepared.robot, prepared.params
    to_grasp = T_base_tcp[:, :3, 3] - robot.shoulder_m
    ways = (0.0, -params.pregrasp_m * T_base_tcp[:, :3, 2], params.lift_m * T_base_world[:3, 2])
    farthest_m = np.max([np.linalg.norm(to_grasp + way, axis=1) for way in ways], axis=0)
    return farthest_m <= robot.reach_m

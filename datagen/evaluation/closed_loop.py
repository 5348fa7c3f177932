"""A closed loop: methods pick cells of whole grids, robots arrive off them, and plan from there."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.console.options import AssetSources
from datagen.evaluation.arrival_outcomes import Arrived, SceneTask, read_outcomes, scene_generator
from datagen.evaluation.columns import Columns
from datagen.evaluation.comparisons import SEED, Method, comparisons
from datagen.evaluation.grids import (
    AT_RANDOM,
    BY_LABELS,
    DISTANCES_M,
    PICKS,
    GridMaps,
    decisive_grids,
    grid_maps,
    mean_of_scenes,
    method_values,
    smoothed,
)
from datagen.evaluation.report import RESAMPLES
from datagen.evaluation.runs import EvaluatedRun
from datagen.evaluation.scores import weights_for
from datagen.replaying import places_of
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run, find_scene, open_runs
from datagen.train.arrivals import Arrival, ring_arrival
from datagen.train.bootstrap import Estimate, Weights
from datagen.train.inputs import F64, I64, Bools

# Nav2 lets a robot be off by 0.25 m and 0.25 rad.
_YAW_RAD_PER_M = 1.0
# Arrivals a scene, error and pick. Executing takes most of the time.
REPEATS = {"plan": 3, "sim": 1}

Pick = tuple[str, str]  # a method, and one of PICKS
Names = npt.NDArray[np.object_]
# A scene and a purpose (0: picks, 1: arrivals) -> the scene's own generator.
Generators = Callable[[int, int], np.random.Generator]


@dataclass(frozen=True, eq=False)
class Loop:
    """S scenes with a good clear cell, E arrival errors with D arrivals each, and a task for each scene."""

    columns: Columns
    maps: GridMaps
    arrivals: tuple[Arrival, ...]  # (E,)
    cells: Mapping[Pick, I64]  # (E, S) each, index into Y * X cells
    offsets: F64  # (E, S, D, 3), in the frame of the goal: x ahead, y to the left (m), yaw (rad)
    tasks: tuple[SceneTask, ...]  # (S,)
    without_good: int  # whole grids without a good clear cell
    mode: str


def plan_loop(
    columns: Columns,
    runs: Sequence[EvaluatedRun],
    given: AssetSources,
    methods: Sequence[Method],
    arrivals: Sequence[Arrival],
    most_scenes: int,
    mode: str,
    folder: str,
    seen_houses: frozenset[str],
) -> Loop:
    """The loop over the whole grids of `columns`; without `arrivals`, errors of 0 to 25 cm with a yaw error.

    Scenes in `seen_houses` are left out.

    InputError where no scene has a whole grid with a good clear cell.
    """
    place = runs[0].place
    if not columns.is_grid.any():
        fix = "Submit plan or sim with --candidates-per-scene grid"
        raise InputError(place, "candidates", "no scene has a whole grid of one robot", fix)
    good = np.bincount(columns.scene, columns.label & columns.is_clear, columns.n_scenes) > 0
    is_seen = np.isin(columns.house.astype(str), np.array(sorted(seen_houses), str))
    kept = np.flatnonzero(columns.is_grid & good & ~is_seen)[:most_scenes]
    if not len(kept):
        problem = f"none of {int(columns.is_grid.sum())} whole grids, in unseen houses, has a good clear cell"
        raise InputError(place, "label", problem, "Name a larger run")
    columns_kept = columns.of_scenes(np.isin(np.arange(columns.n_scenes), kept))
    maps = grid_maps(columns_kept)
    if maps is None:
        raise InputError(place, "candidates", "the grids differ in size", "Give the runs one by one")
    origins = _scenes_of(columns, runs, kept)

    def generators(scene: int, purpose: int) -> np.random.Generator:
        run, index = origins[scene]
        return scene_generator(SEED, run.manifest.spec_hash, index, purpose)

    errors = tuple(arrivals) or tuple(ring_arrival(d, d * _YAW_RAD_PER_M) for d in DISTANCES_M)
    cells = pick_cells(columns_kept, maps, methods, errors, generators)
    offsets = draw_offsets(errors, REPEATS[mode], len(kept), generators)
    candidates = [candidates_of(maps, each) for each in cells.values()]
    tasks = tuple(
        SceneTask(
            run.storage.url,
            run.manifest.spec,
            *places_of(run, given),
            scene,
            mode,
            SEED,
            folder,
            _distinct([each[:, k] for each in candidates], offsets[:, k]),
        )
        for k, (run, scene) in enumerate(origins)
    )
    without_good = int((columns.is_grid & ~good & ~is_seen).sum())
    return Loop(columns_kept, maps, errors, cells, offsets, tasks, without_good, mode)


def _scenes_of(columns: Columns, runs: Sequence[EvaluatedRun], kept: I64) -> list[tuple[Run, int]]:
    """The run, or part of merged runs, of each scene, and its index there; streams keep the stored order."""
    opened = [open_runs(run.place) for run in runs]
    starts = np.searchsorted(columns.run, np.arange(len(runs)))
    return [
        find_scene(opened[row], scene - int(starts[row]))
        for scene, row in zip(kept.tolist(), columns.run[kept].tolist(), strict=True)
    ]


def pick_cells(
    columns: Columns,
    maps: GridMaps,
    methods: Sequence[Method],
    arrivals: Sequence[Arrival],
    generators: Generators,
) -> dict[Pick, I64]:
    """The cell (E, S) that each method picks, and the picks without a method.

    A nominal pick is the clear cell with the best score, a smoothed one that with the best mean of the score
    over the error (as `arrival_table`). Ties are broken at random, the same for all methods.
    """
    luck = np.stack([generators(k, 0).random((2, *maps.truth.shape[1:])) for k in range(columns.n_scenes)])

    def best(value: F64, luck: F64 = luck[:, 0]) -> I64:
        masked = np.where(maps.is_clear, value, -np.inf)
        top = masked >= masked.max(axis=(1, 2), keepdims=True) - 1e-12
        return np.where(top & maps.is_clear, luck, -1.0).reshape(len(luck), -1).argmax(axis=1)

    raw = {m.name: columns.scores[m.name][maps.order] for m in methods}
    values = {m.name: method_values(raw[m.name], maps, m) for m in methods} | {BY_LABELS: maps.truth}
    cells: dict[Pick, I64] = {}
    for name, score in (raw | {BY_LABELS: maps.truth}).items():
        cells[name, "nominal"] = np.stack([best(score)] * len(arrivals))
        cells[name, "smoothed"] = np.stack(
            [best(smoothed(values[name], maps, arrival)) for arrival in arrivals]
        )
    within = best(columns.is_reachable[maps.order].astype(np.float64), luck[:, 1])
    return cells | {(AT_RANDOM, "nominal"): np.stack([within] * len(arrivals))}


def draw_offsets(arrivals: Sequence[Arrival], n: int, n_scenes: int, generators: Generators) -> F64:
    """`n` arrivals (E, S, n, 3) a scene and error, with the same directions for all errors."""
    drawn = [[arrival.drawn(n, generators(k, 1)) for k in range(n_scenes)] for arrival in arrivals]
    # Rounded, and without -0: its numbers identify an arrival.
    return np.round(np.array(drawn), 6) + 0.0


def candidates_of(maps: GridMaps, cells: I64) -> I64:
    """Index (E, S), within its scene, of the candidate in each cell (E, S)."""
    rows = maps.order.reshape(len(maps.order), -1)
    return rows[np.arange(len(rows)), cells] - rows.min(axis=1)


def _arrived(candidate: int, offsets: F64) -> list[Arrived]:
    """The arrivals (D) at a candidate, by their offsets (D, 3)."""
    return [Arrived(candidate, *offset) for offset in offsets.tolist()]


def _distinct(candidates: Sequence[I64], offsets: F64) -> tuple[Arrived, ...]:
    """The distinct arrivals of picks (E,) in one scene, with offsets (E, D, 3), by candidate."""
    every = {
        arrived
        for of_pick in candidates
        for candidate, each in zip(of_pick.tolist(), offsets, strict=True)
        for arrived in _arrived(candidate, each)
    }
    return tuple(sorted(every))


def loop_record(loop: Loop, methods: Sequence[Method]) -> dict[str, Any]:
    """The numbers of a loop whose arrivals are all made, over all scenes and over the decisive ones."""
    known = [read_outcomes(task.path) for task in loop.tasks]
    outcomes = {
        pick: np.array(
            [
                [[known[k][each.key] for each in _arrived(c, loop.offsets[e, k])] for k, c in enumerate(row)]
                for e, row in enumerate(candidates_of(loop.maps, cells).tolist())
            ],
            object,
        )
        for pick, cells in loop.cells.items()
    }
    weights = weights_for(loop.columns, RESAMPLES, SEED)
    decisive = decisive_grids(loop.columns)
    table = partial(loop_table, outcomes, loop.arrivals, methods, weights)
    sides = {"all": np.ones(len(decisive), np.bool_), "decisive": decisive}
    return {
        "mode": loop.mode,
        "arrivals_per_scene": int(loop.offsets.shape[2]),
        "scenes_without_good": loop.without_good,
        "arrivals": {
            "wanted": sum(each.size for each in outcomes.values()),
            "distinct": sum(len(task.arrivals) for task in loop.tasks),
        },
        "parts": [
            {"scenes_of": name, "scenes": int(rows.sum()), "table": table(rows)}
            for name, rows in sides.items()
            if rows.any()
        ],
    }


def loop_table(
    outcomes: Mapping[Pick, Names],
    arrivals: Sequence[Arrival],
    methods: Sequence[Method],
    weights: Weights,
    scenes: Bools,
) -> list[dict[str, Any]]:
    """Success of every pick for each arrival error over some of the S scenes, with intervals over scenes.

    `outcomes` are keys of OUTCOMES; `weights` (B, S) resample the scenes. `gains` are paired differences of
    smoothed and nominal picks, `comparisons` those of methods' smoothed picks.
    """
    found: list[dict[str, Any]] = []
    for e, arrival in enumerate(arrivals):
        rates: dict[str, dict[str, Estimate]] = {}
        results: dict[str, dict[str, Any]] = {}
        for (name, pick), of_pick in outcomes.items():
            ends = of_pick[e, scenes]
            rates.setdefault(name, {})[pick] = rate = mean_of_scenes(
                (of_pick[e] == "success").mean(axis=1), scenes, weights, int(scenes.sum())
            )
            causes, count = np.unique(ends[ends != "success"].astype(str), return_counts=True)
            shares = sorted(zip((count / ends.size).tolist(), causes.tolist(), strict=True), reverse=True)
            results.setdefault(name, {})[pick] = {
                **rate.values(),
                "failures": {cause: share for share, cause in shares},
            }
        of_methods = {m.name: rates[m.name] for m in methods}
        found.append(
            {
                "arrival": arrival.text,
                "distance_m": arrival.distance_m,
                "yaw_std_rad": arrival.yaw_std_rad,
                "methods": results,
                "gains": {
                    name: by_pick["smoothed"].minus(by_pick["nominal"]).values()
                    for name, by_pick in rates.items()
                    if len(by_pick) == len(PICKS)
                },
                "comparisons": comparisons(of_methods, {m.name: m.origin for m in methods}, ("smoothed",)),
            }
        )
    return found

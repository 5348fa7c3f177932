"""The closed loop of scored grids: arrivals to make, and the document of their outcomes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from datagen import __version__
from datagen.closed_loop.arrivals_of_scene import SIM, Arrived, SceneTask, read_outcomes, scene_generator
from datagen.console.options import AssetSources
from datagen.evaluation_report.evaluated_runs import EvaluatedRun
from datagen.evaluation_report.methods import BaselineMethods, EvaluatedMethod
from datagen.schemas.errors import InputError
from datagen.schemas.merged_runs import find_scene, open_runs
from datagen.schemas.run import Run
from datagen.train.arrivals import Arrival, ring_arrival
from datagen.train.evaluation.arrival_success import DISTANCES_M, GridMaps, grid_maps
from datagen.train.evaluation.bootstrap import LEVEL
from datagen.train.evaluation.closed_loop import (
    Names,
    Pick,
    Turns,
    candidates_of,
    label_success,
    loop_table,
    plan_turns,
)
from datagen.train.evaluation.columns import Columns
from datagen.train.evaluation.evaluation import weights_for
from datagen.train.evaluation.grids import HARD_SHARE, mixed_grids
from datagen.train.inputs import F64, I64

# Nav2 lets a robot be off by 0.25 m and 0.25 rad.
_YAW_RAD_PER_M = 1.0


@dataclass(frozen=True, eq=False)
class Loop:
    """S scenes with a good clear cell, the turns in them, and a task for each."""

    columns: Columns
    maps: GridMaps
    arrivals: tuple[Arrival, ...]
    turns: Turns
    candidates: Mapping[Pick, I64]  # (E, S) each, like the cells of `turns`
    tasks: tuple[SceneTask, ...]  # (S,)
    without_good: int  # whole grids without a good clear cell
    mode: str

    def arrived(self, pick: Pick, error: int, scene: int) -> list[Arrived]:
        """The arrivals (D) of one pick."""
        candidate = int(self.candidates[pick][error, scene])
        offsets = self.turns.offsets[error, scene].tolist()
        return _arrived(candidate, offsets, self.mode)


def arrivals_of(given: Sequence[Arrival]) -> tuple[Arrival, ...]:
    """The arrival errors of a closed loop: those given, else 0 to 25 cm with a yaw error in proportion."""
    return tuple(given) or tuple(ring_arrival(d, d * _YAW_RAD_PER_M) for d in DISTANCES_M)


def plan_loop(
    columns: Columns,
    runs: Sequence[EvaluatedRun],
    given: AssetSources,
    methods: Sequence[EvaluatedMethod],
    arrivals: Sequence[Arrival],
    n: int,
    most_scenes: int | None,
    mode: str,
    seed: int,
    folder: str,
) -> Loop:
    """The loop over the whole grids of `columns`, `n` arrivals per scene, error and pick.

    InputError where no scene has a whole grid with a good clear cell.
    """
    first = runs[0].place
    if not columns.is_grid.any():
        fix = "Submit plan or sim with --candidates-per-scene grid"
        raise InputError(first, "candidates", "no scene has a whole grid of one robot", fix)
    good = np.bincount(columns.scene, columns.label & columns.is_clear, columns.n_scenes) > 0
    kept = np.flatnonzero(columns.is_grid & good)[:most_scenes]
    if not len(kept):
        problem = f"none of {int(columns.is_grid.sum())} whole grids has a good clear cell"
        raise InputError(first, "label", problem, "Name a larger run")
    counted = columns.of_scenes(np.isin(np.arange(columns.n_scenes), kept))
    maps = grid_maps(counted)
    if maps is None:
        raise InputError(first, "candidates", "the grids differ in size", "Give the runs one by one")
    origins = _scenes_of(columns, runs, kept)

    def generators(scene: int, purpose: int) -> np.random.Generator:
        run, index = origins[scene]
        return scene_generator(seed, run.manifest.spec_hash, index, purpose)

    turns = plan_turns(counted, maps, [m.method for m in methods], arrivals, n, generators)
    candidates = {pick: candidates_of(maps, cells) for pick, cells in turns.cells.items()}
    tasks = tuple(
        _task(*origins[k], _distinct(candidates, turns.offsets, k, mode), given, mode, seed, folder)
        for k in range(len(kept))
    )
    without_good = int((columns.is_grid & ~good).sum())
    return Loop(counted, maps, tuple(arrivals), turns, candidates, tasks, without_good, mode)


def _scenes_of(columns: Columns, runs: Sequence[EvaluatedRun], kept: I64) -> list[tuple[Run, int]]:
    """The run, or part of merged runs, of each scene, and its index there; streams keep the stored order."""
    opened = [open_runs(run.place) for run in runs]
    starts = np.searchsorted(columns.run, np.arange(len(runs)))
    return [
        find_scene(opened[row], scene - int(starts[row]))
        for scene, row in zip(kept.tolist(), columns.run[kept].tolist(), strict=True)
    ]


def _task(
    run: Run,
    scene: int,
    arrivals: tuple[Arrived, ...],
    given: AssetSources,
    mode: str,
    seed: int,
    folder: str,
) -> SceneTask:
    sources = run.manifest.sources
    return SceneTask(
        run.storage.url,
        run.manifest.spec,
        given.houses or sources.get("houses", "builtin"),
        given.objects or sources.get("objects", "builtin"),
        scene,
        mode,
        seed,
        folder,
        arrivals,
    )


def _arrived(candidate: int, offsets: Sequence[Sequence[float]], mode: str) -> list[Arrived]:
    return [
        Arrived(candidate, x, y, yaw, world if mode == SIM else 0)
        for world, (x, y, yaw) in enumerate(offsets)
    ]


def _distinct(candidates: Mapping[Pick, I64], offsets: F64, scene: int, mode: str) -> tuple[Arrived, ...]:
    """The distinct arrivals of all picks in one scene, those of one candidate together."""
    found = {
        arrived
        for of_pick in candidates.values()
        for error, candidate in enumerate(of_pick[:, scene].tolist())
        for arrived in _arrived(candidate, offsets[error, scene].tolist(), mode)
    }
    return tuple(sorted(found))


def loop_record(
    loop: Loop,
    baselines: BaselineMethods,
    models: Sequence[EvaluatedMethod],
    runs: Sequence[EvaluatedRun],
    fit: Sequence[str],
    resamples: int,
    seed: int,
) -> dict[str, Any]:
    """The JSON document of a loop whose arrivals are all made."""
    known = [read_outcomes(task.path) for task in loop.tasks]
    outcomes = {pick: _outcomes(loop, pick, known) for pick in loop.turns.cells}
    by_labels = {
        pick: label_success(loop.columns, loop.maps, cells, loop.turns.offsets)
        for pick, cells in loop.turns.cells.items()
    }
    origins = {m.name: m.origin for m in (*baselines.baselines, *models)}
    weights = weights_for(loop.columns, resamples, seed)
    _, hard = mixed_grids(loop.columns)
    sides = [("all", np.ones(len(hard), np.bool_)), ("hard", hard)]
    bilinear = {pick: labels[1] for pick, labels in by_labels.items()}
    return {
        "datagen": __version__,
        "mode": loop.mode,
        "runs": [run.record() for run in runs],
        "fitted_on": list(fit),
        "methods": [m.record() for m in (*baselines.baselines, *models)],
        "left_out": baselines.left_out,
        "bootstrap": {"resamples": resamples, "seed": seed, "level": LEVEL, "by": "scene"},
        "arrivals_per_scene": int(loop.turns.offsets.shape[2]),
        "scenes_without_good": loop.without_good,
        "hard_share": HARD_SHARE,
        "arrivals": {
            "wanted": sum(int(np.prod(names.shape)) for names in outcomes.values()),
            "distinct": sum(len(task.arrivals) for task in loop.tasks),
        },
        "parts": [
            {
                "scenes_of": name,
                "scenes": int(rows.sum()),
                "table": loop_table(outcomes, bilinear, loop.arrivals, origins, rows, weights),
            }
            for name, rows in sides
            if rows.any()
        ],
        "agreement": _agreement(loop, outcomes, by_labels),
    }


def _outcomes(loop: Loop, pick: Pick, known: Sequence[Mapping[str, str]]) -> Names:
    """Outcomes (E, S, D) of one pick."""
    errors, scenes = loop.turns.cells[pick].shape
    return np.array(
        [[[known[k][a.key] for a in loop.arrived(pick, e, k)] for k in range(scenes)] for e in range(errors)],
        object,
    )


def _agreement(
    loop: Loop, outcomes: Mapping[Pick, Names], by_labels: Mapping[Pick, tuple[F64, F64]]
) -> list[dict[str, Any]]:
    """For each error, the prediction of nearby labels for the distinct arrivals, and their outcomes."""
    found: list[dict[str, Any]] = []
    for e, arrival in enumerate(loop.arrivals):
        seen: dict[tuple[int, Arrived], tuple[bool, float, float]] = {}
        for pick, names in outcomes.items():
            nearest, bilinear = by_labels[pick]
            for k in range(len(loop.tasks)):
                for d, arrived in enumerate(loop.arrived(pick, e, k)):
                    predicted = float(nearest[e, k, d]), float(bilinear[e, k, d])
                    seen[k, arrived] = (names[e, k, d] == "success", *predicted)
        made, near, between = np.array(list(seen.values()), np.float64).T
        found.append(
            {
                "arrival": arrival.text,
                "distinct": len(seen),
                "success": float(made.mean()),
                "nearest_label": float(near.mean()),
                "bilinear_label": float(between.mean()),
                "agree_with_nearest": float((made == near).mean()),
                "good_by_label_alone": float((near > made).mean()),
                "good_by_trial_alone": float((made > near).mean()),
            }
        )
    return found

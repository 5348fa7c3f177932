"""The columns kept of an evaluated run, without its clouds."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from datagen.schemas.errors import InputError
from datagen.train.inputs import F32, F64, I64, Array, Batch, Bools
from datagen.train.scorers import Scorer, scored
from datagen.workers.bases.candidate_sets import in_set

# Further columns of a batch that the evaluation needs.
EXTRA = ("base_is_clear", "mount_distance_m", "house_id", "place", "scene_index")


@dataclass(frozen=True, eq=False)
class Columns:
    """N candidates of S scenes. `scene` and `robot` number both through all runs."""

    scene: I64  # (N,)
    robot: I64  # (N,)
    label: Bools  # (N,)
    is_clear: Bools  # (N,)
    base_xy_m: F32  # (N, 2), target frame
    mount_distance_m: F32  # (N,)
    reach_m: F32  # (N,)
    scores: Mapping[str, F64]  # (N,) each
    house: Array  # (S,) text
    place: Array  # (S,) index in PLACE_KINDS
    run: I64  # (S,) index of the run
    is_grid: Bools  # (S,) whether it has all cells of a grid, for one robot
    # Runs whose candidates were all sampled from a reachable set.
    reached_runs: tuple[int, ...] = ()

    def __len__(self) -> int:
        return len(self.label)

    @property
    def n_scenes(self) -> int:
        """S, the number of scenes."""
        return len(self.house)

    @property
    def is_reachable(self) -> Bools:
        """Whether (N,) the target is within the arm's reach from its mount, or its set: R_in of the paper."""
        return (self.mount_distance_m <= self.reach_m) | np.isin(self.run, self.reached_runs)[self.scene]

    def at(self, rows: Bools) -> Columns:
        """Some of the candidates (N,); the scenes and their numbers stay."""
        return self._cut(rows, np.ones(self.n_scenes, np.bool_))

    def of_scenes(self, kept: Bools) -> Columns:
        """Some of the scenes (S,) with all their rows, renumbered."""
        cut = self._cut(kept[self.scene], kept)
        return replace(cut, scene=(np.cumsum(kept) - 1)[cut.scene])

    def _cut(self, rows: Bools, scenes: Bools) -> Columns:
        cut = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _OF_ALL}
        cut = {name: values[scenes if name in _SCENE_COLUMNS else rows] for name, values in cut.items()}
        scores = {name: score[rows] for name, score in self.scores.items()}
        return Columns(**cut, scores=scores, reached_runs=self.reached_runs)

    def is_in(self, candidates: str) -> Bools:
        """Mask (N,) of the candidates in a set of `CANDIDATE_SETS`."""
        return in_set(candidates, self.is_clear, self.is_reachable)


_SCENE_COLUMNS = ("house", "place", "run", "is_grid")
_OF_ALL = ("scores", "reached_runs")


def gather(
    runs: Sequence[tuple[int, Iterable[Batch[Array]]]],
    scorers: Mapping[str, Scorer],
    seen: Callable[[int], None] = lambda scenes: None,
) -> tuple[Columns, dict[str, float]]:
    """The columns of runs, and the seconds that each scorer took for all their candidates.

    Scorers are given by name. A run is (cells of its whole grids, or 0 where it has none; batches with
    `EXTRA`). `seen` is called with the number of each batch's scenes. InputError where a score is not finite
    or a scene occurs twice.
    """
    parts: list[dict[str, Any]] = []
    seconds = dict.fromkeys(scorers, 0.0)
    known: set[bytes] = set()
    n_scenes = n_robots = 0
    for run, (cells, batches) in enumerate(runs):
        for batch in batches:
            part = _rows(batch, n_scenes, n_robots)
            for name, scorer in scorers.items():
                started_s = time.perf_counter()
                part[f"score {name}"] = scored(scorer, batch)
                seconds[name] += time.perf_counter() - started_s
            _, first = np.unique(part["scene"], return_index=True)
            for sample in (batch.sample_id[row].tobytes() for row in first):
                if sample in known:
                    raise InputError(
                        "RUN", "sample_id", f"{sample.hex()} occurs twice", "Name every run once"
                    )
                known.add(sample)
            parts.append(part | _scenes(batch, run, cells))
            n_scenes, n_robots = n_scenes + len(batch.clouds), n_robots + len(batch.robots)
            seen(len(batch.clouds))
    joined = {name: np.concatenate([p.pop(name) for p in parts]) for name in list(parts[0])}
    scores = {name: joined.pop(f"score {name}") for name in scorers}
    return Columns(**joined, scores=scores, reached_runs=()), seconds


def _rows(batch: Batch[Array], first_scene: int, first_robot: int) -> dict[str, Array]:
    robot = batch.candidates.robot_row
    return {
        "scene": first_scene + batch.robots.cloud_row[robot],
        "robot": first_robot + robot,
        "label": batch.label == 1,
        "is_clear": batch.extra["base_is_clear"].astype(np.bool_),
        "base_xy_m": batch.candidates.base_xy_m,
        "reach_m": batch.robots.arm_reach_m[robot],
        "mount_distance_m": batch.extra["mount_distance_m"],
    }


def _scenes(batch: Batch[Array], run: int, cells: int) -> dict[str, Array]:
    n = len(batch.clouds)
    robots = np.bincount(batch.robots.cloud_row, minlength=n)
    candidates = np.bincount(batch.robots.cloud_row[batch.candidates.robot_row], minlength=n)
    return {
        "house": batch.extra["house_id"],
        "place": batch.extra["place"],
        "run": np.full(n, run, np.int64),
        "is_grid": (robots == 1) & (candidates == cells) & (cells > 0),
    }

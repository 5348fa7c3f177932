"""The columns kept of an evaluated run, without its clouds."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from datagen.schemas.errors import InputError
from datagen.train.inputs import F32, F64, I64, U8, Array, Batch, Bools
from datagen.train.scorers import Scorer, scored
from datagen.workers.bases.candidate_sets import in_set

# Further columns of a batch that the evaluation needs.
EXTRA = (
    *("base_is_clear", "distance_m", "mount_distance_m", "visibility", "outcome"),
    *("house_id", "object_name", "object_digest", "scene_index"),
)
_EXAMPLE_POINTS = 1024


@dataclass(frozen=True, eq=False)
class Columns:
    """N candidates of S scenes. `scene` and `robot` number both through all runs."""

    scene: I64  # (N,)
    robot: I64  # (N,)
    label: Bools  # (N,)
    is_clear: Bools  # (N,)
    outcome: U8  # (N,) codes of OUTCOMES
    base_xy_m: F32  # (N, 2), target frame
    distance_m: F32  # (N,)
    mount_distance_m: F32  # (N,)
    reach_m: F32  # (N,)
    visibility: F32  # (N,)
    scores: Mapping[str, F64]  # (N,) each
    house: Array  # (S,) text
    target: Array  # (S,) text
    target_digest: Array  # (S,) text
    run: I64  # (S,) which of the places
    is_grid: Bools  # (S,) whether all cells of a grid are there, for one robot

    def __len__(self) -> int:
        return len(self.label)

    @property
    def n_scenes(self) -> int:
        """S, the number of scenes."""
        return len(self.house)

    @property
    def is_reachable(self) -> Bools:
        """Whether (N,) the target is within the arm's reach from its mount: R_in of the paper."""
        return self.mount_distance_m <= self.reach_m

    def at(self, rows: Bools) -> Columns:
        """Some of the candidates (N,); the scenes and their numbers stay."""
        cut = {name: getattr(self, name)[rows] for name in _ROWS}
        return Columns(
            **cut,
            scores={name: score[rows] for name, score in self.scores.items()},
            **{name: getattr(self, name) for name in _SCENE_COLUMNS},
        )

    def of_scenes(self, kept: Bools) -> Columns:
        """Some of the scenes (S,) with all their rows, renumbered."""
        rows = kept[self.scene]
        cut = {name: getattr(self, name)[rows] for name in _ROWS}
        cut["scene"] = (np.cumsum(kept) - 1)[cut["scene"]]
        return Columns(
            **cut,
            scores={name: score[rows] for name, score in self.scores.items()},
            **{name: getattr(self, name)[kept] for name in _SCENE_COLUMNS},
        )

    def is_in(self, candidates: str) -> Bools:
        """Mask (N,) of the candidates in a set of `CANDIDATE_SETS`."""
        return in_set(candidates, self.is_clear, self.mount_distance_m, self.reach_m)


_SCENE_COLUMNS = ("house", "target", "target_digest", "run", "is_grid")
_ROWS = tuple(f.name for f in fields(Columns) if f.name not in (*_SCENE_COLUMNS, "scores"))


@dataclass(frozen=True, eq=False)
class Example:
    """An example scene: its number, and P of its points with their colours."""

    scene: int
    points_m: F32  # (P, 3), target frame
    rgb: U8  # (P, 3)
    target_mask: Bools  # (P,)


@dataclass(frozen=True, eq=False)
class Gathered:
    """The columns of a run, scenes to show, and the seconds that each method took to score all of it."""

    columns: Columns
    examples: tuple[Example, ...]
    seconds: Mapping[str, float]


def gather(
    places: Sequence[tuple[int, Iterable[Batch[Array]]]],
    scorers: Mapping[str, Scorer],
    rng: np.random.Generator,
    n_examples: int = 4,
    seen: Callable[[int], None] = lambda scenes: None,
) -> Gathered:
    """Score every candidate of every place by every scorer, a batch at a time.

    Scorers come by the names that they are to have. A place is (cells of its whole grids, or 0 where it
    has none; batches with `EXTRA`). Examples are drawn evenly from the scenes with whole grids and a
    positive. `seen` is called with each batch's scenes. InputError where a score is no number, and where a
    scene comes twice.
    """
    parts: list[dict[str, Any]] = []
    seconds = dict.fromkeys(scorers, 0.0)
    kept = _Reservoir(n_examples, rng)
    known: set[bytes] = set()
    n_scenes = n_robots = 0
    for run, (cells, batches) in enumerate(places):
        for batch in batches:
            part = _rows(batch, n_scenes, n_robots)
            for name, scorer in scorers.items():
                started_s = time.perf_counter()
                part[f"score {name}"] = scored(scorer, batch)
                seconds[name] += time.perf_counter() - started_s
            scenes = len(batch.clouds)
            part |= _scenes(batch, run, cells)
            _refuse_twice(batch, part["scene"] - n_scenes, known)
            kept.offer(batch, part, n_scenes)
            parts.append(part)
            n_scenes, n_robots = n_scenes + scenes, n_robots + len(batch.robots)
            seen(scenes)
    joined = {name: np.concatenate([p.pop(name) for p in parts]) for name in list(parts[0])}
    scores = {name: joined.pop(f"score {name}") for name in scorers}
    return Gathered(Columns(**joined, scores=scores), tuple(kept.examples), seconds)


def _rows(batch: Batch[Array], first_scene: int, first_robot: int) -> dict[str, Array]:
    robot = batch.candidates.robot_row
    return {
        "scene": first_scene + batch.robots.cloud_row[robot],
        "robot": first_robot + robot,
        "label": batch.label == 1,
        "is_clear": batch.extra["base_is_clear"].astype(np.bool_),
        "outcome": batch.extra["outcome"],
        "base_xy_m": batch.candidates.base_xy_m,
        "reach_m": batch.robots.arm_reach_m[robot],
        **{name: batch.extra[name] for name in ("distance_m", "mount_distance_m", "visibility")},
    }


def _scenes(batch: Batch[Array], run: int, cells: int) -> dict[str, Array]:
    n = len(batch.clouds)
    robots = np.bincount(batch.robots.cloud_row, minlength=n)
    candidates = np.bincount(batch.robots.cloud_row[batch.candidates.robot_row], minlength=n)
    return {
        "house": batch.extra["house_id"],
        "target": batch.extra["object_name"][:, 0],
        "target_digest": batch.extra["object_digest"][:, 0],
        "run": np.full(n, run, np.int64),
        "is_grid": (robots == 1) & (candidates == cells) & (cells > 0),
    }


def _refuse_twice(batch: Batch[Array], scene_row: Array, known: set[bytes]) -> None:
    _, first = np.unique(scene_row, return_index=True)
    for name in (batch.sample_id[row].tobytes() for row in first):
        if name in known:
            raise InputError("RUN", "sample_id", f"{name.hex()} occurs twice", "Name every run once")
        known.add(name)


class _Reservoir:
    """A uniform random sample of the given scenes."""

    def __init__(self, wanted: int, rng: np.random.Generator) -> None:
        self._wanted, self._rng, self._offered = wanted, rng, 0
        self.examples: list[Example] = []

    def offer(self, batch: Batch[Array], part: Mapping[str, Array], first_scene: int) -> None:
        positives = np.bincount(part["scene"] - first_scene, part["label"], len(batch.clouds))
        for row in np.flatnonzero(part["is_grid"] & (positives > 0)):
            self._offered += 1
            place = len(self.examples)
            if place == self._wanted:
                place = int(self._rng.integers(self._offered))
            if place < self._wanted:
                self.examples[place : place + 1] = [_example(batch, int(row), first_scene)]


def _example(batch: Batch[Array], row: int, first_scene: int) -> Example:
    clouds = batch.clouds
    n = min(int(clouds.n_points[row]), _EXAMPLE_POINTS)
    points_m, rgb, mask = (a[row, :n].copy() for a in (clouds.points_m, clouds.rgb, clouds.target_mask))
    return Example(first_scene + row, points_m, rgb, mask)

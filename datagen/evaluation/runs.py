"""The runs on which methods are evaluated: their contents, and the candidate sets that they cover."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from datagen.evaluation.columns import EXTRA
from datagen.released import checkpoint_file
from datagen.schemas.errors import InputError
from datagen.schemas.specification import Specification
from datagen.train.baselines import FIELDS
from datagen.train.dataset import SampleStream
from datagen.train.headings import refuse_sampled_yaw
from datagen.train.inputs import Array, Batch
from datagen.train.run_parts import refuse_mixed_labels, specs_of
from datagen.workers.bases.candidate_sets import CANDIDATE_SETS

# Whole scenes: a model scores a few scenes of 625 candidates at once.
SCENES_PER_BATCH = 8
_WITH_OUTCOMES = ("plan", "sim")


@dataclass(frozen=True, eq=False)
class EvaluatedRun:
    """A run, or merged runs, of sim or plan labels."""

    place: str
    specs: tuple[Specification, ...]
    stream: SampleStream

    @property
    def cells(self) -> int:
        """Candidates per scene where one robot has every cell of the grid; else 0."""
        grids = [s.candidates for s in self.specs if s.candidates.per_scene == "grid"]
        return max((c.count for c in grids if c.robots_per_scene == 1), default=0)

    @property
    def offers(self) -> tuple[str, ...]:
        """The candidate sets that the run covers completely or evenly."""
        widths = {None: 3, "clear": 2, "in-range": 1}
        return CANDIDATE_SETS[: min(widths[s.candidates.within] for s in self.specs)]

    def batches(self) -> Iterator[Batch[Array]]:
        """Its candidates in stored order; of several draws of each, the label is that of most."""
        draws = draws_of(self.place, self.specs)
        for batch in self.stream.epoch(0):
            if draws is not None:
                batch = replace(batch, label=(2 * batch.extra["successes"] > draws).astype(np.int64))
            yield batch

    def record(self) -> dict[str, Any]:
        """Its entry in the report."""
        return {
            "place": self.place,
            "scenes": self.stream.n_scenes,
            "samples": self.stream.n_samples,
            "whole_grids_of": self.cells or None,
            "parts": [spec.summary() for spec in self.specs],
            "origin": self.stream.origin(),
        }


def draws_of(place: str, specs: Sequence[Specification]) -> int | None:
    """Draws that each candidate was planned with, None for one. InputError where parts differ."""
    found = {spec.arm.draws for spec in specs if spec.arm is not None}
    if len(found) > 1:
        raise InputError(place, "arm.draws", "differs between its parts", "Evaluate the parts one by one")
    return next(iter(found), None)


def split_paths(paths: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return (checkpoints, runs): files are checkpoints; folders and s3:// addresses are runs.

    `released` is the checkpoint of the released model, unless there is a file or folder of that name.
    """
    checkpoints: list[str] = []
    runs: list[str] = []
    for path in paths:
        if "://" in path or Path(path).is_dir():
            runs.append(path)
        elif file := checkpoint_file(path):
            checkpoints.append(file)
        else:
            fix = "Name checkpoints of `datagen train` and runs of `datagen submit sim`"
            raise InputError(path, "", "is neither a checkpoint file nor a run folder", fix)
    if not runs:
        raise InputError("datagen evaluate", "PATH", "no run is given", "Name one or more run folders")
    return checkpoints, runs


def open_evaluated_runs(paths: Sequence[str]) -> list[EvaluatedRun]:
    """Open the runs.

    InputError for heuristic labels, for labels of different sources or versions, and for equal scenes.
    """
    opened: list[EvaluatedRun] = []
    by_candidates: dict[str, str] = {}
    kinds: dict[str, str] = {}
    for path in paths:
        refuse_no_trials(path)
        specs = specs_of(path)
        for spec in specs:
            kinds.setdefault(spec.label_source, path)
            other = by_candidates.setdefault(spec.candidates_hash, spec.hash())
            if other != spec.hash():
                problem = "are also in another run of this command, with other labels or another viewpoint"
                raise InputError(path, "scenes", problem, "Evaluate the two runs separately")
        if len(kinds) > 1:
            (first, at), (second, _) = kinds.items()
            problem = f"is {second}, but {at} has {first} labels"
            raise InputError(path, "label_source", problem, "Evaluate the two runs separately")
        opened.append(EvaluatedRun(path, specs, stream_of([path])))
    named = [(run.place, spec) for run in opened for spec in run.specs]
    refuse_mixed_labels(named)
    refuse_sampled_yaw(named)
    return opened


def stream_of(paths: Sequence[str]) -> SampleStream:
    """The samples of runs in stored order, with all that evaluation and baselines read."""
    drawn = any(draws_of(path, specs_of(path)) for path in paths)
    extra = tuple(dict.fromkeys((*EXTRA, *FIELDS, *(("successes",) if drawn else ()))))
    return SampleStream(paths, scenes_per_batch=SCENES_PER_BATCH, extra=extra, shuffle=False)


def refuse_no_trials(path: str) -> None:
    """Raise InputError where a run's labels are neither sim nor plan."""
    for spec in specs_of(path):
        source = spec.label_source
        if source not in _WITH_OUTCOMES:
            problem = f"is {source}, but methods are evaluated on simulated labels"
            raise InputError(path, "label_source", problem, "Name a run of `datagen submit sim` or plan")


def candidate_sets_of(runs: Sequence[EvaluatedRun]) -> dict[str, tuple[int, ...]]:
    """The candidate sets to report, each with the runs that offer it.

    A run of in-range candidates covers only those; a run of whole grids covers every set.
    """
    by_name = {n: tuple(k for k, run in enumerate(runs) if n in run.offers) for n in CANDIDATE_SETS}
    return {name: rows for name, rows in by_name.items() if rows}

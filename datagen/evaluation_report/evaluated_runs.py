"""The runs on which methods are evaluated: what they hold, and that no method was trained on it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.evaluation_report.methods import EvaluatedMethod
from datagen.reports.specification_summary import specification_record
from datagen.schemas.errors import InputError
from datagen.schemas.merged_runs import open_runs
from datagen.schemas.specification import Specification
from datagen.train.baselines import FIELDS
from datagen.train.dataset import SampleStream
from datagen.train.evaluation.columns import EXTRA
from datagen.workers.bases.candidate_sets import CANDIDATE_SETS

# Whole scenes with all their candidates: a few of 625 are what a model scores at once.
SCENES_PER_BATCH = 8
_WITH_OUTCOMES = ("plan", "sim")


@dataclass(frozen=True, eq=False)
class EvaluatedRun:
    """A run, or merged ones, of simulated or planned labels; `cells` of its whole grids, 0 without any."""

    place: str
    specs: tuple[Specification, ...]
    stream: SampleStream

    @property
    def cells(self) -> int:
        """Candidates of a scene with one robot on every cell of its grid; 0 where no scene is such."""
        grids = [s.candidates for s in self.specs if s.candidates.per_scene == "grid"]
        return max((c.count for c in grids if c.robots_per_scene == 1), default=0)

    @property
    def offers(self) -> tuple[str, ...]:
        """The sets of candidates that were drawn whole, or evenly."""
        widths = {None: 3, "clear": 2, "in-range": 1}
        return CANDIDATE_SETS[: min(widths[s.candidates.within] for s in self.specs)]

    def record(self) -> dict[str, Any]:
        """What the report says of it."""
        return {
            "place": self.place,
            "scenes": self.stream.n_scenes,
            "samples": self.stream.n_samples,
            "whole_grids_of": self.cells or None,
            "parts": [specification_record(spec) for spec in self.specs],
            "origin": self.stream.origin(),
        }


def split_paths(places: Sequence[str]) -> tuple[list[str], list[str]]:
    """(checkpoints, runs): files are checkpoints; folders and addresses of object stores are runs."""
    checkpoints: list[str] = []
    runs: list[str] = []
    for place in places:
        if "://" in place or Path(place).is_dir():
            runs.append(place)
        elif Path(place).is_file():
            checkpoints.append(place)
        else:
            mend = "Name checkpoints that `datagen train` wrote, and runs of `datagen submit sim`"
            raise InputError(place, "", "neither a checkpoint's file nor a run's folder", mend)
    if not runs:
        problem = "no run is named" if not places else "only checkpoints are named, and no run"
        raise InputError("datagen evaluate", "RUN", problem, "Name one or more run folders")
    return checkpoints, runs


def open_evaluated_runs(places: Sequence[str], allow_incomplete: bool = False) -> list[EvaluatedRun]:
    """The runs. InputError where labels are no trials, or runs hold labels of different kinds or scenes."""
    opened: list[EvaluatedRun] = []
    by_scenes: dict[str, str] = {}
    kinds: dict[str, str] = {}
    for place in places:
        refuse_no_trials(place)
        specs = tuple(run.manifest.spec for run in open_runs(place))
        for spec in specs:
            _refuse_other_labels(place, spec.label_source, kinds)
            other = by_scenes.setdefault(spec.scenes_hash, spec.hash())
            if other != spec.hash():
                problem = "its scenes are those of another run here, labelled otherwise"
                raise InputError(place, "scenes", problem, "Evaluate the two apart")
        extra = tuple(dict.fromkeys((*EXTRA, *FIELDS)))
        stream = SampleStream(
            [place],
            scenes_per_batch=SCENES_PER_BATCH,
            extra=extra,
            shuffle=False,
            allow_incomplete=allow_incomplete,
        )
        opened.append(EvaluatedRun(place, specs, stream))
    return opened


def refuse_no_trials(place: str) -> None:
    """InputError where a run's labels are neither simulated nor planned."""
    for run in open_runs(place):
        source = run.manifest.spec.label_source
        if source not in _WITH_OUTCOMES:
            problem = f"{source} labels, and methods are held against simulated ones"
            raise InputError(place, "label_source", problem, "Name a run of `datagen submit sim`, or plan")


def _refuse_other_labels(place: str, source: str, kinds: dict[str, str]) -> None:
    kinds.setdefault(source, place)
    if len(kinds) > 1:
        (first, at), (second, _) = kinds.items()
        problem = f"{second} labels, and those of {at} are {first}"
        raise InputError(place, "label_source", problem, "Evaluate the two apart")


def candidate_sets_of(runs: Sequence[EvaluatedRun], asked: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """The candidate sets to report, those asked for or all, each with the runs that offer it.

    A run of candidates within reach says nothing of others, and beside it one of whole grids says of all.
    """
    by_name = {n: tuple(k for k, run in enumerate(runs) if n in run.offers) for n in CANDIDATE_SETS}
    offered = {name: rows for name, rows in by_name.items() if rows}
    for name in asked:
        if name not in offered:
            problem = f"no run was made of {name} candidates, but of {list(offered)[-1]}"
            raise InputError(runs[0].place, "--candidates", problem, f"Choose of: {', '.join(offered)}")
    return {name: rows for name, rows in offered.items() if not asked or name in asked}


def refuse_seen_houses(runs: Sequence[EvaluatedRun], evaluated: Iterable[EvaluatedMethod]) -> None:
    """InputError that names a house of these runs on which a method was trained."""
    mend = "Evaluate a run of another split, or say --allow-seen-houses, which tells of them apart"
    by = [(f"{c.name} ({c.place})", c.houses) for c in evaluated]
    for run in runs:
        here = run.stream.house_ids()
        for who, houses in by:
            if shared := sorted(here & houses):
                problem = f"{shared[0]!r} and {len(shared) - 1} more: {who} has seen them in training"
                if len(shared) == 1:
                    problem = f"{shared[0]!r}: {who} has seen it in training"
                raise InputError(run.place, "house_id", problem, mend)

"""The runs on which methods are evaluated: their contents, and checks that no method was trained on them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from datagen.released import checkpoint_file
from datagen.reports.specification_summary import specification_record
from datagen.schemas.errors import InputError
from datagen.schemas.merged_runs import open_runs
from datagen.schemas.specification import Specification
from datagen.train.baselines import FIELDS
from datagen.train.dataset import SampleStream
from datagen.train.evaluation.columns import EXTRA
from datagen.train.label_versions import refuse_mixed_labels
from datagen.workers.bases.candidate_sets import CANDIDATE_SETS

if TYPE_CHECKING:
    from datagen.evaluation_report.methods import EvaluatedMethod

# Whole scenes: a model scores a few scenes of 625 candidates at once.
SCENES_PER_BATCH = 8
_WITH_OUTCOMES = ("plan", "sim")


@dataclass(frozen=True, eq=False)
class EvaluatedRun:
    """A run, or merged runs, of sim or plan labels; `cells` per whole grid, 0 without whole grids."""

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

    def record(self) -> dict[str, Any]:
        """Its entry in the report."""
        return {
            "place": self.place,
            "scenes": self.stream.n_scenes,
            "samples": self.stream.n_samples,
            "whole_grids_of": self.cells or None,
            "parts": [specification_record(spec) for spec in self.specs],
            "origin": self.stream.origin(),
        }


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


def open_evaluated_runs(
    paths: Sequence[str], allow_incomplete: bool = False, allow_mixed_labels: bool = False
) -> list[EvaluatedRun]:
    """Open the runs.

    InputError for heuristic labels, for runs of different kinds or of equal scenes, and, unless
    `allow_mixed_labels`, for labels of different versions.
    """
    opened: list[EvaluatedRun] = []
    by_scenes: dict[str, str] = {}
    kinds: dict[str, str] = {}
    for path in paths:
        refuse_no_trials(path)
        specs = tuple(run.manifest.spec for run in open_runs(path))
        for spec in specs:
            _refuse_other_labels(path, spec.label_source, kinds)
            other = by_scenes.setdefault(spec.scenes_hash, spec.hash())
            if other != spec.hash():
                problem = "are also in another run of this command, with other labels"
                raise InputError(path, "scenes", problem, "Evaluate the two runs separately")
        extra = tuple(dict.fromkeys((*EXTRA, *FIELDS)))
        stream = SampleStream(
            [path],
            scenes_per_batch=SCENES_PER_BATCH,
            extra=extra,
            shuffle=False,
            allow_incomplete=allow_incomplete,
        )
        opened.append(EvaluatedRun(path, specs, stream))
    if not allow_mixed_labels:
        refuse_mixed_labels([(run.place, spec) for run in opened for spec in run.specs])
    return opened


def refuse_no_trials(path: str) -> None:
    """Raise InputError where a run's labels are neither sim nor plan."""
    for run in open_runs(path):
        source = run.manifest.spec.label_source
        if source not in _WITH_OUTCOMES:
            problem = f"is {source}, but methods are evaluated on simulated labels"
            raise InputError(path, "label_source", problem, "Name a run of `datagen submit sim` or plan")


def _refuse_other_labels(path: str, source: str, kinds: dict[str, str]) -> None:
    kinds.setdefault(source, path)
    if len(kinds) > 1:
        (first, at), (second, _) = kinds.items()
        problem = f"is {second}, but {at} has {first} labels"
        raise InputError(path, "label_source", problem, "Evaluate the two runs separately")


def candidate_sets_of(runs: Sequence[EvaluatedRun], requested: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """The candidate sets to report, requested or all, each with the runs that offer it.

    A run of in-range candidates covers only those; a run of whole grids covers every set.
    """
    by_name = {n: tuple(k for k, run in enumerate(runs) if n in run.offers) for n in CANDIDATE_SETS}
    offered = {name: rows for name, rows in by_name.items() if rows}
    for name in requested:
        if name not in offered:
            problem = f"no run covers {name} candidates, only {list(offered)[-1]} ones"
            raise InputError(runs[0].place, "--candidates", problem, f"Choose one of: {', '.join(offered)}")
    return {name: rows for name, rows in offered.items() if not requested or name in requested}


def refuse_seen_houses(
    runs: Sequence[EvaluatedRun],
    evaluated: Iterable[EvaluatedMethod],
    fix: str = "Evaluate a run of another split, or give --allow-seen-houses to report them separately",
) -> None:
    """Raise InputError that names a house of these runs on which a method was trained."""
    trained = [(f"{c.name} ({c.place})", c.houses) for c in evaluated]
    for run in runs:
        here = run.stream.house_ids()
        for method, houses in trained:
            if shared := sorted(here & houses):
                problem = f"{shared[0]!r} and {len(shared) - 1} more: {method} was trained on them"
                if len(shared) == 1:
                    problem = f"{shared[0]!r}: {method} was trained on it"
                raise InputError(run.place, "house_id", problem, fix)

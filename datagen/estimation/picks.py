"""The candidates that methods pick, and the scores of models as further cheap labels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from datagen.display.progress import counting
from datagen.estimation.mixed_labels import MixedLabels
from datagen.evaluation_report.evaluated_runs import SCENES_PER_BATCH
from datagen.evaluation_report.methods import EvaluatedMethod, open_models
from datagen.released import checkpoint_file
from datagen.schemas.errors import InputError, choices
from datagen.train.baselines import BASELINES, FIELDS, make_baselines
from datagen.train.dataset import SampleStream
from datagen.train.evaluation.grids import picks
from datagen.train.inputs import F64
from datagen.train.scorers import scored


@dataclass(frozen=True, eq=False)
class Scored:
    """A method with its scores (N,) of a population's candidates."""

    method: EvaluatedMethod
    score: F64

    @property
    def name(self) -> str:
        return self.method.name

    def member(self, labels: MixedLabels) -> F64:
        """Share (N,) of each candidate in the choice of the best clear one for its robot."""
        return picks(self.score, labels.robot, labels.is_clear)


def open_methods(names: Sequence[str]) -> list[EvaluatedMethod]:
    """Open checkpoints, `released` and baselines. InputError for other names, and for baselines to fit."""
    files = {name: file for name in names if (file := checkpoint_file(name))}
    rules = [name for name in names if name not in files]
    for name in rules:
        if name not in BASELINES:
            problem = "is neither a checkpoint file nor a baseline"
            raise InputError("--methods", name, problem, choices(BASELINES, name))
    made = make_baselines(rules)
    for baseline in made:
        if baseline.needs_fit:
            usable = [b.name for b in make_baselines(list(BASELINES)) if not b.needs_fit]
            problem = "needs runs to fit its parameters on"
            raise InputError("--methods", baseline.name, problem, choices(usable))
    return [*(EvaluatedMethod(b.name, b, state=b.state()) for b in made), *open_models([*files.values()])]


def score_population(
    labels: MixedLabels, methods: Sequence[EvaluatedMethod], json: bool = False
) -> list[Scored]:
    """Score every candidate of the population by every method, with progress on standard error.

    InputError where a model was trained on a house of the population: its scores would be better there than
    elsewhere, and would bias the estimate.
    """
    if not methods:
        return []
    paths = [run.storage.url for run in labels.runs_of(labels.cheap_names[0])]
    scores = score_candidates(paths, labels.sample_id, methods, json, _refuse_seen)
    return [Scored(method, scores[method.name]) for method in methods]


def score_candidates(
    paths: Sequence[str],
    sample_id: npt.NDArray[np.void],
    methods: Sequence[EvaluatedMethod],
    json: bool = False,
    check: Callable[[SampleStream, EvaluatedMethod], None] = lambda stream, method: None,
) -> dict[str, F64]:
    """Return each method's scores (N,) of the samples of these runs, with progress on standard error.

    `check` is called for each run and method before any is scored.
    """
    scores = {method.name: np.full(len(sample_id), np.nan) for method in methods}
    order = np.argsort(sample_id)
    known = sample_id[order]
    streams = [
        SampleStream(
            [path],
            scenes_per_batch=SCENES_PER_BATCH,
            extra=FIELDS,
            shuffle=False,
            allow_incomplete=True,
        )
        for path in paths
    ]
    for method in methods:
        for stream in streams:
            check(stream, method)
    total, done = sum(stream.n_scenes for stream in streams), 0
    with counting("scenes", json) as seen:
        for stream in streams:
            for batch in stream.epoch(0):
                ids = np.ascontiguousarray(batch.sample_id).view("V16").ravel()
                position = np.minimum(np.searchsorted(known, ids), len(known) - 1)
                there = known[position] == ids
                for method in methods:
                    scores[method.name][order[position[there]]] = scored(method.scorer, batch)[there]
                done += len(batch.clouds)
                seen(done, total)
    return scores


def with_models(labels: MixedLabels, scores: Sequence[Scored]) -> MixedLabels:
    """The labels with the probabilities of models as further cheap columns."""
    models: Mapping[str, F64] = {s.name: s.score for s in scores if s.method.head is not None}
    if not models:
        return labels
    population = labels.population
    cheap = np.column_stack([population.cheap, *models.values()])
    return replace(
        labels,
        cheap_names=(*labels.cheap_names, *models),
        population=replace(population, cheap=cheap),
    )


def _refuse_seen(stream: SampleStream, method: EvaluatedMethod) -> None:
    shared = sorted(stream.house_ids() & method.houses)
    if shared:
        path = stream.parts[0].part.place
        problem = f"was trained on {shared[0]!r} and {len(shared) - 1} more houses of {path}"
        fix = "Train it on another split, or estimate on runs of another split"
        raise InputError(method.place, "house_id", problem, fix)

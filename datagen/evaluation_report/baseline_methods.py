"""The baselines that models are compared with, fitted where runs to fit them on are named."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from datagen.configuration.specify import first_of, read_toml
from datagen.evaluation_report.evaluated_runs import SCENES_PER_BATCH, EvaluatedRun, refuse_no_trials
from datagen.evaluation_report.methods import EvaluatedMethod
from datagen.schemas.errors import InputError
from datagen.schemas.progress import steps
from datagen.schemas.specification import HeuristicParams
from datagen.train.baselines import BASELINES, FIELDS, Baseline, fit_baselines, make_baselines
from datagen.train.dataset import SampleStream
from datagen.train.splits import refuse_shared_houses

NONE = "none"


@dataclass(frozen=True, eq=False)
class BaselineMethods:
    """Baselines in their order, those omitted with the reason, and the houses they were fitted on."""

    baselines: tuple[EvaluatedMethod, ...]
    left_out: dict[str, str]
    houses: frozenset[str]


def read_heuristic(path: Path, runs: Sequence[EvaluatedRun], allow_seen_houses: bool) -> HeuristicParams:
    """Read the rule's parameters from a file of `datagen calibrate`.

    InputError where it has none, or where they were fitted on one of `runs`.
    """
    fix = "Give a file of `datagen calibrate`"
    section = read_toml(path, fix).get("heuristic")
    if not isinstance(section, dict):
        raise InputError(path, "heuristic", "is missing", fix)
    fitted_to = set(re.findall(r"^# run ([0-9a-f]{64}):", path.read_text(encoding="utf-8"), re.MULTILINE))
    for run in runs:
        if not allow_seen_houses and any(spec.hash() in fitted_to for spec in run.specs):
            problem = f"was fitted on the labels of {run.place}"
            raise InputError(path, "heuristic", problem, "Calibrate on runs of another split")
    try:
        return HeuristicParams.model_validate(section)
    except ValidationError as error:
        raise first_of(error, str(path), "heuristic") from None


def baseline_methods(
    asked: Sequence[str] | None,
    fit: Sequence[str],
    detector: Path | None,
    heuristic: HeuristicParams | None,
    seed: int,
    runs: Sequence[EvaluatedRun],
    allow_seen_houses: bool,
    allow_incomplete: bool = False,
    json: bool = False,
) -> BaselineMethods:
    """Return the requested baselines; for None all, except those that need --fit where `fit` is empty.

    InputError where a requested one is not available, or where `fit` and `runs` share a house.
    """
    if asked and NONE in asked:
        if len(asked) > 1:
            raise InputError("--baselines", NONE, "is given with others", "Give only none, or omit it")
        return BaselineMethods((), {}, frozenset())
    names = list(dict.fromkeys(asked or BASELINES))
    made = make_baselines(names, detector, heuristic, seed)
    left_out: dict[str, str] = {}
    houses: frozenset[str] = frozenset()
    if fit:
        for place in fit:
            refuse_no_trials(place)
        stream = SampleStream(
            fit,
            scenes_per_batch=SCENES_PER_BATCH,
            extra=FIELDS,
            shuffle=False,
            allow_incomplete=allow_incomplete,
        )
        if not allow_seen_houses:
            for run in runs:
                refuse_shared_houses(stream, run.stream)
        houses = frozenset(stream.house_ids())
        batches = list(stream.epoch(0))
        fitted: list[Baseline] = []
        with steps("baselines fitted", len(made), json) as step:
            for baseline in made:
                fitted += fit_baselines([baseline], batches)
                step()
        made = fitted
    else:
        why = "needs runs to fit its parameters on (--fit)"
        left_out = {name: why for name, b in zip(names, made, strict=True) if b.needs_fit}
        if asked and left_out:
            name = next(iter(left_out))
            raise InputError("--baselines", name, why, "Name runs in validation houses with --fit")
        made = [b for b in made if not b.needs_fit]
    # The note of a method follows its name in brackets.
    told = [(b, *b.name.partition(" (")[::2]) for b in made]
    return BaselineMethods(
        tuple(EvaluatedMethod(name, b, state=b.state(), note=note.rstrip(")")) for b, name, note in told),
        left_out,
        houses,
    )

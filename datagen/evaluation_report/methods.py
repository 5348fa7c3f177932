"""The methods that are evaluated: models by their checkpoints, and baselines, fitted where runs are named."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from datagen.configuration.toml_files import first_of, read_toml
from datagen.display.progress import steps
from datagen.evaluation_report.evaluated_runs import SCENES_PER_BATCH, EvaluatedRun, refuse_no_trials
from datagen.released import RELEASED, released_checkpoint
from datagen.schemas.errors import InputError
from datagen.schemas.identity import digest_of
from datagen.schemas.merged_runs import open_runs
from datagen.schemas.specification import HeuristicParams
from datagen.train.baselines import BASELINES, FIELDS, fit_baselines, make_baselines
from datagen.train.baselines.calibration import Calibration, calibrate
from datagen.train.baselines.scalars import Scalars
from datagen.train.dataset import SampleStream
from datagen.train.evaluation.comparisons import NO_TRAINING, TrainedBy
from datagen.train.evaluation.evaluation import Method
from datagen.train.scorers import ModelScorer, Scorer
from datagen.train.splits import refuse_shared_houses
from datagen.workers.extras import EXTRAS, how_to_get

if TYPE_CHECKING:
    from datagen.train.training.checkpoints import CheckpointHead

NONE = "none"
# Training regime of a checkpoint's stage: stage 2 is the second of two stages.
REGIMES = {"stage1": "stage1", "sim-only": "sim-only", "stage2": "two-stage"}


@dataclass(frozen=True, eq=False)
class EvaluatedMethod:
    """One method and its origin.

    Models have a path and a checkpoint. Baselines have a state and, if they are fitted, a calibration. `note`
    is printed with the method's name.
    """

    name: str
    scorer: Scorer
    place: str = ""
    head: CheckpointHead | None = None
    state: Mapping[str, Any] = field(default_factory=dict)
    note: str = ""
    calibration: Calibration | None = None
    gives_probabilities: bool = False  # of methods other than models and `scalars`

    @property
    def regime(self) -> str:
        """Training regime of a model; "" for a baseline."""
        return REGIMES.get(self.head.stage, self.head.stage) if self.head else ""

    @property
    def origin(self) -> TrainedBy:
        """Key of the training, to compare models that differ in one part of it."""
        if self.head is None:
            return NO_TRAINING
        return TrainedBy(self.regime, self.head.model, house_share(self.head))

    @property
    def recipe(self) -> str:
        """Digest of a training without its seed; "" for baselines and for checkpoints that do not tell it."""
        head = self.head
        if head is None or "seed" not in head.options:
            return ""
        told = {k: getattr(head, k) for k in ("model", "model_config", "stage", "house_ids", "val_house_ids")}
        told["options"] = {k: v for k, v in head.options.items() if k != "seed"}
        told["samples"] = [origin["samples_sha256"] for origin in (*head.data, *head.val_data)]
        if head.init:  # the stage 1 of each seed is another
            told["init"] = head.init["stage" if head.init["stage"] == "stage1" else "digest"]
        return digest_of(told)

    @property
    def method(self) -> Method:
        """The method for the metrics."""
        trained = self.head is not None or isinstance(self.scorer, Scalars)
        is_probability = trained or self.gives_probabilities
        return Method(
            self.name, self.scorer.threshold, self.origin, is_probability, self.calibration, self.recipe
        )

    @property
    def houses(self) -> frozenset[str]:
        """Houses of its training and validation."""
        return frozenset(self.head.house_ids + self.head.val_house_ids) if self.head else frozenset()

    @property
    def objects(self) -> frozenset[str]:
        """Digests of the objects of its training."""
        return frozenset(self.head.object_digests) if self.head else frozenset()

    def record(self) -> dict[str, Any]:
        """Its entry in the report."""
        base = {
            "name": self.name,
            "regime": self.regime or None,
            "threshold": None if self.method.only_picks else self.scorer.threshold,
            "note": self.note or None,
        }
        if self.head is None:
            return {**base, "checkpoint": None, "state": dict(self.state)}
        head = self.head
        return {
            **base,
            "checkpoint": {
                "place": self.place,
                "sha256": head.digest,
                "model": head.model,
                "config": head.model_config,
                "stage": head.stage,
                "data": list(head.data),
                "best_epoch": head.best_epoch,
                "finished": head.finished,
                "cost": head.cost,
                "init": head.init,
            },
        }


@dataclass(frozen=True, eq=False)
class BaselineMethods:
    """Baselines in their order, those omitted with the reason, and the houses they were fitted on."""

    baselines: tuple[EvaluatedMethod, ...]
    left_out: dict[str, str]
    houses: frozenset[str]


def read_heuristic(path: Path, runs: Sequence[EvaluatedRun], allow_seen_houses: bool) -> HeuristicParams:
    """The rule of a file of `datagen calibrate`. InputError where it was fitted on one of `runs`."""
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
    requested: Sequence[str] | None,
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
    if requested and NONE in requested:
        if len(requested) > 1:
            raise InputError("--baselines", NONE, "is given with others", "Give only none, or omit it")
        return BaselineMethods((), {}, frozenset())
    names = list(dict.fromkeys(requested or BASELINES))
    left_out: dict[str, str] = {}
    if not requested and EXTRAS["sim"].missing():
        names.remove("reachability")
        left_out["reachability"] = f"needs the robots' files. {how_to_get('sim')}"
    specs = [spec for run in runs for spec in run.specs]
    specs += [run.manifest.spec for path in fit for run in open_runs(path)]
    robots = tuple(dict.fromkeys(spec.arm.robot for spec in specs if spec.arm is not None))
    made = make_baselines(names, detector, heuristic, seed, robots)
    calibrations: dict[str, Calibration] = {}
    houses: frozenset[str] = frozenset()
    if fit:
        for path in fit:
            refuse_no_trials(path)
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
        with steps("baselines fitted", len(made), json) as step:
            for k, baseline in enumerate(made):
                (made[k],) = fit_baselines([baseline], batches)
                calibrations[made[k].name] = calibrate(made[k], batches)
                step()
    else:
        why = "needs runs to fit its parameters on (--fit)"
        unfitted = {name: why for name, b in zip(names, made, strict=True) if b.needs_fit}
        left_out |= unfitted
        if requested and unfitted:
            name = next(iter(unfitted))
            raise InputError("--baselines", name, why, "Name runs in validation houses with --fit")
        made = [b for b in made if not b.needs_fit]
    # The note of a method follows its name in brackets.
    named = [(b, *b.name.partition(" (")[::2]) for b in made]
    return BaselineMethods(
        tuple(
            EvaluatedMethod(
                name, b, state=b.state(), note=note.rstrip(")"), calibration=calibrations.get(b.name)
            )
            for b, name, note in named
        ),
        left_out,
        houses,
    )


def open_models(paths: Sequence[str]) -> list[EvaluatedMethod]:
    """The models of these checkpoints, with unique names by regime; the released one has its own."""
    if not paths:
        return []
    from datagen.train.training.checkpoints import load_model

    loaded = [(path, *load_model(path)) for path in paths]
    released = str(released_checkpoint())
    names = _names(
        [(RELEASED if path == released else _regime_name(head), head.model) for path, _, head in loaded]
    )
    by_digest: dict[str, str] = {}
    for path, _, head in loaded:
        if head.digest in by_digest:
            raise InputError(path, "", f"is the same checkpoint as {by_digest[head.digest]}", "Name it once")
        by_digest[head.digest] = path
    return [
        EvaluatedMethod(name, ModelScorer(model, name, only_clear=True), path, head)
        for (path, model, head), name in zip(loaded, names, strict=True)
    ]


def house_share(head: CheckpointHead) -> float:
    """Share of the available houses that the model was trained on."""
    share = head.options.get("house_share", 1.0)
    return float(share) if isinstance(share, (int, float)) else 1.0


def _regime_name(head: CheckpointHead) -> str:
    regime, share = REGIMES.get(head.stage, head.stage), house_share(head)
    return regime if share == 1 else f"{regime} {share:.0%}"


def _names(known: Sequence[tuple[str, str]]) -> list[str]:
    """A name for each (regime, model): the regime alone, with the model, or with a number as well."""
    regimes, both = Counter(regime for regime, _ in known), Counter(known)
    numbers: Counter[tuple[str, str]] = Counter()
    names: list[str] = []
    for regime, model in known:
        numbers[regime, model] += 1
        name = regime if regimes[regime] == 1 else f"{regime} {model}"
        names.append(name if both[regime, model] == 1 else f"{name} {numbers[regime, model]}")
    return names

"""The methods that are evaluated: models by their checkpoints, fitted baselines, and files of scores."""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError
from safetensors import safe_open

from datagen.configuration.toml_files import first_of, read_toml
from datagen.display.progress import counting, steps
from datagen.evaluation.columns import Columns, gather
from datagen.evaluation.comparisons import NO_TRAINING, Method, TrainedBy
from datagen.evaluation.runs import EvaluatedRun, refuse_no_trials, stream_of
from datagen.evaluation.score_files import ScoreFile, read_scores
from datagen.released import RELEASED, released_checkpoint, released_program
from datagen.schemas.errors import InputError
from datagen.schemas.identity import digest_of
from datagen.schemas.specification import HeuristicParams
from datagen.train.baselines import BASELINES, fit_baselines, make_baselines
from datagen.train.baselines.baseline import Calibration, calibrate
from datagen.train.baselines.scalars import Scalars
from datagen.train.headings import refuse_other_heading, side_deg_of, trained_side_deg
from datagen.train.program_scorer import ProgramScorer
from datagen.train.run_parts import read_robots, refuse_twins, specs_of
from datagen.train.scorers import ModelScorer, Scorer, weights_sha256
from datagen.train.splits import refuse_shared_houses
from datagen.workers.extras import EXTRAS, how_to_get
from datagen.workers.robots import ROBOTS

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

    @property
    def regime(self) -> str:
        """Training regime of a model; "" for a baseline."""
        return REGIMES.get(self.head.stage, self.head.stage) if self.head else ""

    @property
    def origin(self) -> TrainedBy:
        """Key of the training, to compare models that differ in one part of it."""
        if self.head is None:
            return NO_TRAINING
        share = self.head.options.get("house_share")
        return TrainedBy(
            self.regime, self.head.model, float(share) if isinstance(share, int | float) else 1.0
        )

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
        is_probability = isinstance(self.scorer, (ModelScorer, ProgramScorer, Scalars)) or (
            isinstance(self.scorer, ScoreFile) and self.scorer.gives_probabilities
        )
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
        """Its entry in the report; a checkpoint is named by its file name and its digests."""
        base = {
            "name": self.name,
            "regime": self.regime or None,
            "threshold": None if self.method.only_picks else self.scorer.threshold,
            "note": self.note or None,
        }
        if self.head is None:
            return {**base, "checkpoint": None, "state": dict(self.state)}
        scorer = self.scorer
        assert isinstance(scorer, (ModelScorer, ProgramScorer))

        kept = ("model", "stage", "data", "best_epoch", "finished", "cost", "init")
        checkpoint = {
            "file": Path(self.place).name,
            "sha256": self.head.digest,
            "weights_sha256": scorer.weights_sha256
            if isinstance(scorer, ProgramScorer)
            else weights_sha256(scorer.model),
            "config": self.head.model_config,
            **{name: getattr(self.head, name) for name in kept},
        }
        return {**base, "checkpoint": checkpoint}


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
    runs: Sequence[EvaluatedRun],
    heuristic: HeuristicParams | None = None,
    allow_seen_houses: bool = False,
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
    specs += [spec for path in fit for spec in specs_of(path)]
    arms = [spec.arm for spec in specs if spec.arm is not None]
    robots = tuple(dict.fromkeys(arm.robot_key for arm in arms if arm.robot in ROBOTS))
    made = make_baselines(names, heuristic, robots)
    calibrations: dict[str, Calibration] = {}
    houses: frozenset[str] = frozenset()
    if fit:
        for path in fit:
            refuse_no_trials(path)
        fitted = [EvaluatedRun(path, specs_of(path), stream_of([path])) for path in fit]
        refuse_twins([summary.part for each in fitted for summary in each.stream.parts])
        if not allow_seen_houses:
            for each, run in product(fitted, runs):
                refuse_shared_houses(each.stream, run.stream)
        houses = houses.union(*(each.stream.house_ids() for each in fitted))
        batches = [batch for each in fitted for batch in each.batches()]
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
    return BaselineMethods(
        tuple(
            EvaluatedMethod(b.name, b, state=b.state(), calibration=calibrations.get(b.name)) for b in made
        ),
        left_out,
        houses,
    )


def open_models(paths: Sequence[str], runs: Sequence[EvaluatedRun] = ()) -> list[EvaluatedMethod]:
    """The models of these checkpoints, named by their files; the released one has its own name.

    InputError where bases of `runs` stand to the target otherwise than those that one was trained on.
    """
    found: list[EvaluatedMethod] = []
    for path in paths:
        name, scorer, head = _released() if path == str(released_checkpoint()) else _model(path)
        other_deg = trained_side_deg(head)
        if other_deg is None:
            read_robots(summary.part for run in runs for summary in run.stream.parts)
        for place, spec in ((run.place, spec) for run in runs for spec in run.specs):
            refuse_other_heading(place, "candidates.yaw_rad", side_deg_of(spec), path, other_deg)
        found.append(EvaluatedMethod(name, scorer, path, head))
    return found


def _model(path: str) -> tuple[str, ModelScorer, CheckpointHead]:
    from datagen.train.training.checkpoints import load_model

    model, head = load_model(path)
    return Path(path).stem, ModelScorer(model, path, only_clear=True), head


def _released() -> tuple[str, ProgramScorer, CheckpointHead]:
    """The released model as a program, and its checkpoint's metadata, both without torch."""
    file = released_checkpoint()
    document = json.loads(safe_open(file, "numpy").metadata()["head"])
    head: Any = SimpleNamespace(**document["head"], digest=hashlib.sha256(file.read_bytes()).hexdigest())
    return RELEASED, ProgramScorer(released_program(), only_clear=True), head


def open_methods(
    named: Sequence[str], fit: Sequence[str], runs: Sequence[EvaluatedRun], json: bool
) -> list[EvaluatedMethod]:
    """Checkpoints, baselines and files of scores, in the order in which they are named.

    InputError for an unknown method, and where `fit` and `runs` share a house.
    """
    kinds = {each: _kind(each) for each in named}
    checkpoints = [each for each, kind in kinds.items() if kind == "checkpoint"]
    paths = [str(released_checkpoint()) if each == RELEASED else each for each in checkpoints]
    found = dict(zip(checkpoints, open_models(paths, runs), strict=True))
    if baselines := [each for each, kind in kinds.items() if kind == "baseline"]:
        made = baseline_methods(baselines, fit, runs, json=json)
        found |= dict(zip(baselines, made.baselines, strict=True))
    files = {each: read_scores(Path(each)) for each, kind in kinds.items() if kind == "scores"}
    found |= {each: EvaluatedMethod(f.name, f, note="scores of a file") for each, f in files.items()}
    return [found[each] for each in kinds]


def _kind(named: str) -> str:
    path = Path(named)
    if named in BASELINES:
        return "baseline"
    if named == RELEASED or path.is_file():
        return "scores" if path.suffix.lower() == ".csv" else "checkpoint"
    fix = f"Give {RELEASED}, a checkpoint, a file of scores (.csv), or a baseline: {', '.join(BASELINES)}"
    raise InputError("METHOD", named, "is no file and no baseline", fix)


def refuse_seen_houses(
    runs: Sequence[EvaluatedRun],
    evaluated: Iterable[EvaluatedMethod],
    fix: str = "Evaluate a run of another split, or give --allow-seen-houses to report them separately",
) -> None:
    """Raise InputError that names a house of these runs on which a method was trained."""
    for run in runs:
        here = run.stream.house_ids()
        for method in evaluated:
            if shared := sorted(here & method.houses):
                problem = f"{method.name} ({method.place}) was trained on {shared[0]!r}"
                problem += f" and {len(shared) - 1} more of its houses" if len(shared) > 1 else ""
                raise InputError(run.place, "house_id", problem, fix)


def score_runs(
    runs: Sequence[EvaluatedRun], methods: Sequence[EvaluatedMethod], json: bool
) -> tuple[Columns, dict[str, float]]:
    """The columns of all runs in stored order, and each method's seconds per 600 candidates, with progress.

    InputError for two methods of one name.
    """
    for name, count in Counter(method.name for method in methods).items():
        if count > 1:
            raise InputError("METHOD", name, "is the name of two methods", "Rename one of the files")
    with counting("scenes", json) as seen:
        total, done = sum(run.stream.n_scenes for run in runs), 0

        def step(scenes: int) -> None:
            nonlocal done
            done += scenes
            seen(done, total)

        batches = [(run.cells, run.batches()) for run in runs]
        columns, seconds = gather(batches, {m.name: m.scorer for m in methods}, step)
    reached = (k for k, run in enumerate(runs) if all(s.candidates.in_range_by for s in run.specs))
    columns = replace(columns, reached_runs=tuple(reached))
    return columns, {name: 600 * spent_s / len(columns) for name, spent_s in seconds.items()}

"""`datagen calibrate`: fit the heuristic's parameters to labels of grasp trials."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from datagen.console.options import AllowIncomplete, AsJson, Whole, refuse_odd_draws, refuse_output
from datagen.console.printing import print_json, print_rows
from datagen.display.progress import steps
from datagen.evaluation_report.report_tables import with_interval
from datagen.reports.specification_summary import specification_record
from datagen.schemas.errors import InputError, one_line, printable
from datagen.schemas.merged_runs import open_runs
from datagen.schemas.specification import HeuristicParams, Specification
from datagen.workers.bases.candidate_sets import CANDIDATE_SETS, in_set

if TYPE_CHECKING:
    from datagen.train.evaluation.bootstrap import Estimate
    from datagen.train.heuristic_fit import Agreement, Trials

Sets = Literal["grid", "clear", "in-range"]
Form = Literal["planar", "planar-over-reach", "mount-over-reach"]

_SAMPLE_FIELDS = ("distance_m", "mount_distance_m", "arm_reach_m", "visibility", "base_is_clear", "label")
_COUNTS = ("true_positive", "false_positive", "false_negative", "true_negative")
_METRICS = {"accuracy": "accuracy", "balanced_accuracy": "balanced accuracy"}


@dataclass(frozen=True, eq=False)
class _Calibrated:
    """Parameters before and after the fit, and their agreement with the trial labels."""

    before: HeuristicParams
    after: HeuristicParams
    by_fold: tuple[HeuristicParams, ...]
    agreements: dict[str, Agreement]  # before, after (on houses left out), fitted (on the fitted labels)


def calibrate(
    runs: Annotated[list[str], Parameter(name="RUN...")],
    /,
    *,
    out: Path,
    candidates: Sets = "clear",
    distance: Literal[Form, "any"] = "planar",
    objective: Literal["balanced", "accuracy"] = "balanced",
    fit_alpha: bool = False,
    split_check: bool = False,
    bootstrap: Whole = 1000,
    seed: Whole = 0,
    allow_incomplete: AllowIncomplete = False,
    json: AsJson = False,
) -> int:
    """Fit mu, sigma_l, sigma_r and tau of the distance-visibility rule to labels of grasp trials.

    The report compares the agreement before and after the fit, the latter on houses left out of the fit, with
    intervals by resampling scenes. The file has the section [heuristic] that `datagen submit heuristic
    --config FILE` and `datagen relabel RUN --config FILE` accept.

    For example: datagen calibrate runs/sim-val --out rule.toml

    Args:
        runs: Runs of sim or plan labels.
        out: The .toml file to write; it must not exist.
        candidates: The candidates to fit on.
        distance: Distance that the score depends on; any: the best.
        objective: Metric to maximise: balanced accuracy or accuracy.
        fit_alpha: Also fit the weight of the visibility score.
        split_check: Fail, instead of warn, where a run is not of --split val.
        bootstrap: Resamples of scenes for each interval.
        seed: Seed of the folds and the resamples.
    """
    refuse_odd_draws(bootstrap, seed)
    refuse_output(out, "--out", ".toml")
    if out.exists() or out.is_symlink():
        raise InputError(out, "--out", "already exists", "Choose another name, or remove it first")
    specs, warnings = _specifications(runs, candidates, split_check)
    from datagen.train.heuristic_fit import FOLDS, FORMS, refuse_too_little

    if specs[0].heuristic.alpha == 1 and not fit_alpha:
        problem = "is 1 in these runs, so the distance score has no weight to fit"
        raise InputError(runs[0], "heuristic.alpha", problem, "Give --fit-alpha")
    trials = _read(runs, candidates, allow_incomplete)
    refuse_too_little(trials, ", ".join(runs))
    forms = FORMS if distance == "any" else (distance,)
    for warning in warnings:
        sys.stderr.write(f"warning: {one_line(warning)}\n")
    with steps("fits", 1 + min(FOLDS, len(set(trials.house))), json) as step:
        made = _calibrate(trials, specs[0].heuristic, forms, objective, fit_alpha, bootstrap, seed, step)
    report = {
        "out": str(out),
        "candidates": candidates,
        "objective": objective,
        "seed": seed,
        "resamples": bootstrap,
        "samples": len(trials),
        "positives": int(trials.label.sum()),
        "scenes": trials.n_scenes,
        "houses": len(set(trials.house)),
        "runs": [specification_record(spec) for spec in specs],
        "warnings": warnings,
        **_findings(made),
    }
    options = {"--candidates": candidates, "--distance": distance, "--objective": objective}
    flags = [*(["--fit-alpha"] if fit_alpha else []), *(["--split-check"] if split_check else [])]
    words = [*runs, "--out", str(out), *(word for option in options.items() for word in option), *flags]
    command = shlex.join(["datagen", "calibrate", *words, "--bootstrap", str(bootstrap), "--seed", str(seed)])
    _write_new(out, _toml(report, command, made.after))
    if json:
        print_json(report)
        return 0
    title = (
        f"{len(trials):,} {candidates} candidates of {trials.n_scenes:,} scenes in {report['houses']} houses"
    )
    print_rows(f"{title}: {out}", list(_rows(report)), ("", "before", "after", "gain", "fitted houses"))
    print_rows("[heuristic]", list(_parameter_rows(made)), ("", "before", "after", "over folds"))
    return 0


def _specifications(
    paths: Sequence[str], candidates: Sets, split_check: bool
) -> tuple[list[Specification], list[str]]:
    """Specifications of all runs, and warnings. InputError where their labels cannot be fitted together."""
    found: list[tuple[str, Specification]] = [
        (path, run.manifest.spec) for path in paths for run in open_runs(path)
    ]
    first_path, first = found[0]
    scenes: set[str] = set()
    warnings: list[str] = []
    for path, spec in found:
        if spec.label_source == "heuristic":
            problem = "heuristic labels come from the rule itself and cannot calibrate it"
            fix = "Name a run with trials of its scenes: datagen submit sim --scenes-from RUN"
            raise InputError(path, "label_source", problem, fix)
        if spec.label_source != first.label_source:
            problem = f"is {spec.label_source}, but {first_path} has {first.label_source} labels"
            raise InputError(path, "label_source", problem, "Name runs of one label source")
        if spec.heuristic != first.heuristic:
            problem = f"differs from that of {first_path}"
            raise InputError(path, "heuristic", problem, "Calibrate the two runs separately")
        if spec.scenes_hash in scenes:
            problem = "are also in another run of this command"
            raise InputError(path, "scenes", problem, "Name each set of scenes once")
        scenes.add(spec.scenes_hash)
        held = spec.candidates.within or "grid"
        if CANDIDATE_SETS.index(candidates) > CANDIDATE_SETS.index(held):
            problem = f"the run has {held} candidates, not {candidates}"
            raise InputError(path, "--candidates", problem, f"Give --candidates {held}")
        if spec.split != "val":
            problem = f"is {spec.split}, but parameters are chosen on val"
            if split_check:
                fix = "Make a run with `datagen submit --split val`, or omit --split-check"
                raise InputError(path, "split", problem, fix)
            warnings.append(f"{path}: split {problem}: evaluate on other houses")
    return [spec for _, spec in found], warnings


def _read(paths: Sequence[str], candidates: Sets, allow_incomplete: bool) -> Trials:
    """The labels of all runs over the chosen set of candidates."""
    import numpy as np

    from datagen.train.heuristic_fit import Trials
    from datagen.train.reader import SampleReader

    reader = SampleReader(paths, ("house_id",), _SAMPLE_FIELDS, allow_incomplete)
    parts: list[dict[str, Any]] = []
    n_scenes = 0
    for columns in reader.shards():
        columns["scene_row"] = columns["scene_row"] + n_scenes
        n_scenes += len(columns["house_id"])
        parts.append(columns)
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    all_trials = Trials(
        scene=joined["scene_row"],
        house=joined["house_id"],
        **{name: joined[name] for name in ("distance_m", "mount_distance_m", "arm_reach_m", "visibility")},
        label=joined["label"] == 1,
    )
    is_clear = joined["base_is_clear"].astype(np.bool_)
    return all_trials.at(in_set(candidates, is_clear, all_trials.mount_distance_m, all_trials.arm_reach_m))


def _calibrate(
    trials: Trials,
    before: HeuristicParams,
    forms: Sequence[Form],
    objective: Literal["balanced", "accuracy"],
    fit_alpha: bool,
    resamples: int,
    seed: int,
    step: Any,
) -> _Calibrated:
    from datagen.train.heuristic_fit import agreements, fit, fit_leaving_houses_out

    def refit(some: Trials) -> HeuristicParams:
        return fit(some, before, forms, objective, fit_alpha)

    after = refit(trials)
    if len(set(trials.labels_by(after).tolist())) == 1:
        problem = f"the best parameters give all {len(trials):,} candidates one label"
        fix = "Choose --objective balanced, another --distance, or other --candidates"
        raise InputError("datagen calibrate", "--objective", problem, fix)
    step()
    left_out = fit_leaving_houses_out(trials, refit, seed, step)
    predicted = {
        "before": trials.labels_by(before),
        "after": left_out.labels,
        "fitted": trials.labels_by(after),
    }
    found = agreements(trials, list(predicted.values()), resamples, seed)
    return _Calibrated(before, after, left_out.params, dict(zip(predicted, found, strict=True)))


def _findings(made: _Calibrated) -> dict[str, Any]:
    from datagen.train.evaluation.bootstrap import verdict

    def record(agreement: Agreement) -> dict[str, Any]:
        counts = dict(zip(_COUNTS, map(int, agreement.confusion), strict=True))
        return {name: _estimate(getattr(agreement, name)) for name in _METRICS} | {"confusion": counts}

    records = {name: record(agreement) for name, agreement in made.agreements.items()}
    gain: dict[str, Any] = {}
    for name in _METRICS:
        difference = getattr(made.agreements["after"], name).minus(getattr(made.agreements["before"], name))
        gain[name] = {**_estimate(difference), "verdict": verdict(difference)}
    return {
        "before": {"heuristic": made.before.model_dump(), **records["before"]},
        "after": {"heuristic": made.after.model_dump(), **records["after"]},
        "on_the_fitted": records["fitted"],
        "gain": gain,
        "folds": [params.model_dump() for params in made.by_fold],
    }


def _estimate(estimate: Estimate) -> dict[str, float | None]:
    low, high = estimate.interval()
    numbers = {"value": estimate.value, "low": low, "high": high}
    return {name: number if number == number else None for name, number in numbers.items()}  # nan


def _rows(report: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    columns = [report[name] for name in ("before", "after", "gain", "on_the_fitted")]
    for metric, words in _METRICS.items():
        shown = [with_interval(column[metric], signed=column is report["gain"]) for column in columns]
        yield (f"{words} (%)", *shown)
    for count in _COUNTS:
        before, after, _, fitted = (column.get("confusion", {}).get(count, 0) for column in columns)
        yield (count.replace("_", " "), f"{before:,}", f"{after:,}", f"{after - before:+,}", f"{fitted:,}")


def _parameter_rows(made: _Calibrated) -> Iterator[tuple[str, ...]]:
    before, after = made.before.model_dump(), made.after.model_dump()
    for name, value in after.items():
        found = [params.model_dump()[name] for params in made.by_fold]
        each = sorted(set(found)) if isinstance(value, str) else [min(found), max(found)]
        yield (name, str(before[name]), str(value), " .. ".join(str(v) for v in dict.fromkeys(each)))


def _toml(report: dict[str, Any], command: str, params: HeuristicParams) -> str:
    """The complete section below a comment with the origin of its numbers."""
    runs = [
        f"{run['spec_hash']}: {run['label_source']}{', disturbed' if run['disturbed'] else ''}, "
        f"split {run['split']}, seed {run['seed']}, {run['candidates']} candidates"
        for run in report["runs"]
    ]
    share = report["positives"] / report["samples"]
    lines = [
        "The distance-visibility rule, fitted to labels of trials.",
        command,
        *(f"run {run}" for run in runs),
        f"n {report['samples']:,} {report['candidates']} candidates, {share:.1%} positive, of "
        f"{report['scenes']:,} scenes in {report['houses']:,} houses",
        f"objective {_METRICS.get(report['objective'], 'balanced accuracy')}, seed {report['seed']}; "
        f"intervals from {report['resamples']:,} resamples of scenes",
        *(
            f"{words} (%): before {with_interval(report['before'][metric])}, "
            f"after {with_interval(report['after'][metric])} in houses left out of the fit"
            for metric, words in _METRICS.items()
        ),
        *(f"warning {warning}" for warning in report["warnings"]),
    ]
    comments = "".join(f"# {printable(line)}\n" for line in lines)
    section = "".join(
        f"{name} = {value!r}\n" if isinstance(value, float) else f'{name} = "{value}"\n'
        for name, value in params.model_dump().items()
    )
    return f"{comments}\n[heuristic]\n{section}"


def _write_new(path: Path, text: str) -> None:
    """Create the file; InputError where another process created it meanwhile."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        fix = "Choose another name, or remove it first"
        raise InputError(path, "--out", "already exists", fix) from None

"""`datagen calibrate`: fit the heuristic's parameters to labels of grasp trials."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from cyclopts import Parameter

from datagen.console.options import AllowIncomplete, AsJson, refuse_output
from datagen.console.printing import print_json, print_rows
from datagen.display.progress import steps
from datagen.evaluation.report_tables import with_interval
from datagen.schemas.errors import InputError, one_line, printable
from datagen.schemas.run import open_runs
from datagen.schemas.specification import DISTANCES, Distance, HeuristicParams, Specification
from datagen.train.heuristic_fit import (
    FOLDS,
    Trials,
    agreements,
    fit,
    fit_leaving_houses_out,
    refuse_too_little,
)
from datagen.train.reader import read_shards
from datagen.train.run_parts import JOIN_FIELDS, open_parts
from datagen.workers.bases.candidate_sets import CANDIDATE_SETS, in_set

Sets = Literal["grid", "clear", "in-range"]

_INPUTS = ("distance_m", "mount_distance_m", "arm_reach_m", "visibility")
_METRICS = {"accuracy": "accuracy", "balanced_accuracy": "balanced accuracy"}


def calibrate(
    runs: Annotated[list[str], Parameter(name="RUN...")],
    /,
    *,
    out: Path,
    candidates: Sets = "clear",
    distance: Literal[Distance, "any"] = "planar",
    allow_incomplete: AllowIncomplete = False,
    json: AsJson = False,
) -> int:
    """Fit mu, sigma_l, sigma_r and tau of the distance-visibility rule to labels of grasp trials.

    The rule is fitted for balanced accuracy. The report compares it before and after the fit, the latter on
    houses left out of the fit, with intervals by resampling scenes. The file has the section [heuristic] that
    `datagen submit heuristic --config FILE` and `datagen relabel RUN --config FILE` accept.

    For example: datagen calibrate runs/sim-val --out rule.toml

    Args:
        runs: Runs of sim or plan labels.
        out: The .toml file to write; it must not exist.
        candidates: The candidates to fit on.
        distance: Distance that the score depends on; any: the best.
    """
    refuse_output(out, "--out", ".toml")
    if out.exists() or out.is_symlink():
        raise InputError(out, "--out", "already exists", "Choose another name, or remove it first")
    specs = _specifications(runs, candidates)
    trials = _read(runs, candidates, allow_incomplete, all(s.candidates.within == "in-range" for s in specs))
    refuse_too_little(trials, ", ".join(runs))
    forms: tuple[Distance, ...] = DISTANCES if distance == "any" else (distance,)
    before = specs[0].heuristic

    def refit(some: Trials) -> HeuristicParams:
        return fit(some, before, forms)

    with steps("fits", 1 + min(FOLDS, len(set(trials.house))), json) as step:
        after = refit(trials)
        labels = trials.labels_by(after)
        if labels.all() or not labels.any():
            problem = f"the best parameters give all {len(trials):,} candidates one label"
            raise InputError("datagen calibrate", "--distance", problem, "Choose another, or --candidates")
        step()
        left_out = fit_leaving_houses_out(trials, refit, step)
    report: dict[str, Any] = {
        "out": str(out),
        "candidates": candidates,
        "samples": len(trials),
        "positives": int(trials.label.sum()),
        "scenes": len(trials.house),
        "houses": len(set(trials.house)),
        "runs": [spec.summary() for spec in specs],
        "heuristic": {"before": before.model_dump(), "after": after.model_dump()},
        "folds": [params.model_dump() for params in left_out.params],
        **_agreements(
            trials, {"before": trials.labels_by(before), "after": left_out.labels, "fitted": labels}
        ),
    }
    with out.open("x", encoding="utf-8") as file:
        file.write(_toml(report))
    if json:
        print_json(report)
        return 0
    title = (
        f"{len(trials):,} {candidates} candidates of {report['scenes']:,} scenes, {report['houses']} houses"
    )
    columns = ("before", "after", "gain", "fitted")
    rows = [
        (f"{words} (%)", *(with_interval(report[c][name], signed=c == "gain") for c in columns))
        for name, words in _METRICS.items()
    ]
    print_rows(f"{title}: {out}", rows, ("", "before", "after", "gain", "fitted houses"))
    old, new = report["heuristic"]["before"], report["heuristic"]["after"]
    print_rows("[heuristic]", [(n, str(old[n]), str(new[n])) for n in new], ("", "before", "after"))
    return 0


def _specifications(paths: Sequence[str], candidates: Sets) -> list[Specification]:
    """Specifications of all runs. InputError where their labels cannot be fitted together."""
    found: list[tuple[str, Specification]] = [
        (path, run.manifest.spec) for path in paths for run in open_runs(path)
    ]
    first_path, first = found[0]
    scenes: set[str] = set()
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
        if spec.candidates_hash in scenes:
            problem = "are also in another run of this command"
            raise InputError(path, "scenes", problem, "Name each set of scenes once")
        scenes.add(spec.candidates_hash)
        held = spec.candidates.within or "grid"
        if CANDIDATE_SETS.index(candidates) > CANDIDATE_SETS.index(held):
            problem = f"the run has {held} candidates, not {candidates}"
            raise InputError(path, "--candidates", problem, f"Give --candidates {held}")
        if spec.split != "val":
            warning = (
                f"{path}: split is {spec.split}, but parameters are chosen on val: evaluate on other houses"
            )
            sys.stderr.write(f"warning: {one_line(warning)}\n")
    return [spec for _, spec in found]


def _read(paths: Sequence[str], candidates: Sets, allow_incomplete: bool, all_reached: bool) -> Trials:
    """The labels of all runs over the chosen set of candidates; `all_reached`: all are within reach."""
    fields = ("house_id", *_INPUTS, "base_is_clear", "label")
    parts: list[dict[str, Any]] = []
    n_scenes = 0
    for columns in read_shards(open_parts(paths, (*fields, *JOIN_FIELDS), allow_incomplete)):
        columns["scene_row"] = columns["scene_row"] + n_scenes
        n_scenes += len(columns["house_id"])
        parts.append(columns)
    joined = {name: np.concatenate([part[name] for part in parts]) for name in ("scene_row", *fields)}
    trials = Trials(
        scene=joined["scene_row"],
        house=joined["house_id"],
        **{name: joined[name] for name in _INPUTS},
        label=joined["label"] == 1,
    )
    is_clear = joined["base_is_clear"].astype(np.bool_)
    is_reachable = (trials.mount_distance_m <= trials.arm_reach_m) | all_reached
    return trials.at(in_set(candidates, is_clear, is_reachable))


def _agreements(trials: Trials, labels: dict[str, Any]) -> dict[str, Any]:
    """Metrics of the rules' labels, by rule, and the gain from before to after."""
    found = dict(zip(labels, agreements(trials, list(labels.values())), strict=True))
    gain = [after.minus(before) for before, after in zip(found["before"], found["after"], strict=True)]
    return {
        name: {metric: each.values() for metric, each in zip(_METRICS, column, strict=True)}
        for name, column in {**found, "gain": gain}.items()
    }


def _toml(report: dict[str, Any]) -> str:
    """The complete section below a comment with the origin of its numbers."""
    share = report["positives"] / report["samples"]
    lines = ["The distance-visibility rule, fitted to labels of trials by datagen calibrate."]
    lines += [
        f"run {run['spec_hash']}: {run['label_source']}{', disturbed' if run['disturbed'] else ''}, "
        f"split {run['split']}, seed {run['seed']}, {run['candidates']} candidates"
        for run in report["runs"]
    ]
    lines.append(
        f"n {report['samples']:,} {report['candidates']} candidates, {share:.1%} positive, of "
        f"{report['scenes']:,} scenes in {report['houses']:,} houses"
    )
    lines += [
        f"{words} (%): before {with_interval(report['before'][metric])}, "
        f"after {with_interval(report['after'][metric])} in houses left out of the fit"
        for metric, words in _METRICS.items()
    ]
    comments = "".join(f"# {printable(line)}\n" for line in lines)
    section = "".join(
        f"{name} = {value!r}\n" if isinstance(value, float) else f'{name} = "{value}"\n'
        for name, value in report["heuristic"]["after"].items()
    )
    return f"{comments}\n[heuristic]\n{section}"

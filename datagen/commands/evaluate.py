"""`datagen evaluate`: compare models and baselines on simulated labels, with the paper's numbers."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from datagen.console.command_lines import interruptible, print_interrupted, prints
from datagen.console.options import AS_FOUND, AsJson, AssetSources, File, PathsOrAddresses, Whole
from datagen.evaluation.output import output_file, print_report, write_report
from datagen.schemas.errors import InputError

_MOST_WORKERS = 256


@prints(print_report)
def evaluate(
    paths: Annotated[Sequence[str | Path], Parameter(name="PATH...")],
    /,
    *,
    fit: PathsOrAddresses | None = None,
    baselines: Sequence[str] | None = None,
    heuristic: File | None = None,
    arrival: Sequence[str] | None = None,
    closed_loop: Whole | None = None,
    execute: bool = False,
    workers: Whole | None = None,
    given: AssetSources = AS_FOUND,
    allow_seen_houses: bool = False,
    out: File | None = None,
    full: bool = False,
    json: AsJson = False,
) -> dict[str, Any]:
    """Compare models with baselines and the paper: accuracy, reach, grid selection and calibration.

    Methods are compared over candidate sets (grid: all cells; clear: where the base fits; in-range: clear and
    within the arm's reach), with intervals by resampling scenes. Files are checkpoints; folders and s3://
    addresses are runs. Runs with a house that a model was trained on are refused.

    With --closed-loop a robot is sent to each method's picks on whole grids, arrives off them, and plans from
    there. Outcomes are kept next to the output: after Ctrl-C, or with more methods, the same command makes
    only the missing ones.

    For example: datagen evaluate model.ckpt runs/sim-test --out report.json

    Args:
        paths: Checkpoints of `datagen train`, or `released`, and runs of sim or plan labels.
        fit: Run in validation houses to fit baselines on; repeat for more.
        baselines: Baseline to compare with, or none; repeat for more. [default: all]
        heuristic: Parameters of the analytic baseline, from `datagen calibrate`.
        arrival: Arrival error: normal:M[,YAW], disc:M[,YAW] or nav2. [default: 0 to 25 cm]
        closed_loop: Scenes of the closed loop, the first whole grids with a good base pose, in unseen houses.
            [default: no closed loop]
        execute: Execute the plans of the closed loop in disturbed physics, which takes most of the time.
        workers: Processes of the closed loop; 0: this process, for debuggers. [default: cores]
        allow_seen_houses: Report training houses separately instead of failing.
        out: File to write, FILE.json.
        full: Print all tables and notes.

    Returns:
        All numbers, as `datagen evaluate --json` prints them (docs/guides/evaluate.md).

    Raises:
        InputError: A checkpoint, a run or an option cannot be used.

    Examples:
        >>> report = datagen.evaluate([checkpoint, sim_run], baselines=["proximity"])
        >>> len(report["methods"]), list(report["parts"][0]["sets"])
        (2, ['in-range'])
    """
    # Imported here, so that other verbs do not wait for them and for torch.
    from datagen.evaluation.methods import (
        baseline_methods,
        open_models,
        read_heuristic,
        refuse_seen_houses,
        score_runs,
    )
    from datagen.evaluation.report import evaluation_report, parts_by_houses
    from datagen.evaluation.runs import candidate_sets_of, open_evaluated_runs, split_paths
    from datagen.train.arrivals import read_arrival

    file = output_file(out)
    arrivals = [read_arrival(text) for text in arrival or ()]
    loop_options = {"--execute": execute, "--workers": workers is not None, "--houses": given != AS_FOUND}
    for option in (name for name, is_given in loop_options.items() if is_given and closed_loop is None):
        raise InputError(option, "", "is for --closed-loop", "Give --closed-loop SCENES, or omit it")
    kept = "" if closed_loop is None else _kept_outcomes(closed_loop, execute, workers, file)
    checkpoints, run_paths = split_paths([str(path) for path in paths])
    runs = open_evaluated_runs(run_paths)
    if arrivals and closed_loop is None and not any(run.cells for run in runs):
        fix = "Name a run of --candidates-per-scene grid, or omit it"
        raise InputError("--arrival", "", "is for picks on whole grids, which no run has", fix)
    models = open_models(checkpoints, runs)
    if not allow_seen_houses:
        refuse_seen_houses(runs, models)
    rule = None if heuristic is None else read_heuristic(Path(heuristic), runs, allow_seen_houses)
    fitted_on = [str(path) for path in fit or ()]
    plain = baseline_methods(baselines, fitted_on, runs, rule, allow_seen_houses, json)
    if rule is not None and all(method.name != "analytic" for method in plain.baselines):
        fix = "Give --baselines analytic too, or omit it"
        raise InputError("--heuristic", str(heuristic), "is for the baseline analytic alone", fix)
    methods = [*plain.baselines, *models]
    if not methods:
        fix = "Name a checkpoint, or omit --baselines"
        raise InputError("datagen evaluate", "PATH", "no model or baseline given", fix)
    columns, seconds = score_runs(runs, methods, json)
    seen = plain.houses.union(*(model.houses for model in models))
    parts = parts_by_houses(columns, seen, candidate_sets_of(runs))
    report = evaluation_report(seconds, methods, runs, parts, fitted_on, plain.left_out, arrivals)
    if closed_loop is not None:
        from datagen.evaluation.arrival_outcomes import PLAN, SIM, make_all
        from datagen.evaluation.closed_loop import loop_record, plan_loop

        judged = [method.method for method in methods]
        mode = SIM if execute else PLAN
        loop = plan_loop(columns, runs, given, judged, arrivals, closed_loop, mode, kept, seen)
        processes = len(os.sched_getaffinity(0)) if workers is None else workers
        with interruptible() as stopping:
            if not make_all(loop.tasks, processes, stopping, json):
                print_interrupted("; finished arrivals are kept", sys.argv[1:])
                raise KeyboardInterrupt
        report["closed_loop"] = loop_record(loop, judged)
    write_report(report, file)
    return report


def _kept_outcomes(scenes: int, execute: bool, workers: int | None, file: Path | None) -> str:
    """The folder of a closed loop's outcomes, next to the output."""
    from datagen.configuration.robot_fields import refuse_missing_packages

    for option, value, least, most in (
        ("--closed-loop", scenes, 1, 10**9),
        ("--workers", workers or 0, 0, _MOST_WORKERS),
    ):
        if not least <= value <= most:
            raise InputError(option, str(value), f"is not from {least} to {most:,}", "Give another number")
    if file is None:
        fix = "Give --out FILE.json: its outcomes are kept in a folder next to it"
        raise InputError("--closed-loop", "--out", "is missing", fix)
    refuse_missing_packages("sim" if execute else "plan")
    return str(file.with_suffix(".arrivals"))

"""`datagen closed-loop`: send a robot to methods' picks with arrival errors, and execute."""

from __future__ import annotations

import json as json_text
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from datagen.console.command_lines import interruptible, print_interrupted
from datagen.console.options import (
    AS_FOUND,
    AsJson,
    AssetSources,
    File,
    PathsOrAddresses,
    Whole,
    refuse_odd_draws,
)
from datagen.console.printing import print_json
from datagen.display.progress import counting
from datagen.schemas.errors import InputError
from datagen.schemas.whole_files import whole_file

_MOST_REPEATS, _MOST_WORKERS = 1000, 256
_VERB = "datagen closed-loop"


def closed_loop(
    paths: Annotated[list[str], Parameter(name="PATH...")],
    /,
    *,
    out: Path,
    mode: Literal["plan", "sim"] = "sim",
    arrival: Sequence[str] | None = None,
    repeats: Whole = 3,
    scenes: Whole | None = None,
    fit: PathsOrAddresses | None = None,
    baselines: Sequence[str] | None = None,
    detector: File | None = None,
    heuristic: File | None = None,
    bootstrap: Whole = 1000,
    seed: Whole = 0,
    workers: Whole | None = None,
    given: AssetSources = AS_FOUND,
    json: AsJson = False,
) -> int:
    """Send a robot to each method's pick with an arrival error, plan from there, and execute.

    Over whole grids of runs, each method picks the clear cell with its best score, and the one with the best
    mean score over the arrival error. A base that arrives where it does not fit fails. The robot knows where
    it arrived and plans from there; with --mode sim the plan is executed with errors of target, friction and
    mass. Equal arrivals are made once. After Ctrl-C, or with more methods, the same command makes
    only what is missing.

    For example: datagen closed-loop model.ckpt runs/grids --fit runs/val --out loop

    Args:
        paths: Checkpoints of `datagen train`, or `released`, and runs of plan or sim labels with whole grids.
        out: Folder for arrivals, closed-loop.json and closed-loop.svg.
        mode: End with the plan, or execute it too, which takes most of the time.
        arrival: Arrival error: normal:M[,YAW], disc:M[,YAW], nav2 or FILE.csv; repeat for more [0 to 25 cm].
        repeats: Arrivals for each scene, error and pick.
        scenes: Scenes to use, the first that have a good base pose [all].
        fit: Run in validation houses to fit baselines on; repeat for more.
        baselines: Baseline to compare with, or none; repeat for more [all].
        detector: Folder of a zero-shot object detector, for the detector baseline.
        heuristic: Parameters of the analytic baseline, from `datagen calibrate`.
        bootstrap: Resamples of scenes for each interval.
        seed: Seed of arrivals, disturbances and resamples.
        workers: Processes [cores]; 0: this process, for debuggers.
    """
    refuse_odd_draws(bootstrap, seed)
    for option, value, least, most in (
        ("--repeats", repeats, 1, _MOST_REPEATS),
        ("--scenes", scenes, 1, 10**9),
        ("--workers", workers, 0, _MOST_WORKERS),
    ):
        if value is not None and not least <= value <= most:
            raise InputError(_VERB, option, f"{value} is not from {least} to {most:,}", "Give another number")
    if out.exists() and not out.is_dir():
        raise InputError(out, "", "is not a folder", "Give another --out")
    # Imported here, so that other verbs do not wait for them and for torch.
    from datagen.closed_loop.arrivals_of_scene import make_arrivals
    from datagen.closed_loop.loop import arrivals_of, loop_record, plan_loop
    from datagen.closed_loop.loop_figure import draw_loop
    from datagen.closed_loop.loop_tables import print_loop
    from datagen.cluster.process_pool import work_through
    from datagen.configuration.specify import refuse_missing_packages
    from datagen.evaluation_report.evaluated_runs import (
        open_evaluated_runs,
        refuse_seen_houses,
        split_paths,
    )
    from datagen.evaluation_report.methods import baseline_methods, open_models, read_heuristic
    from datagen.evaluation_report.scoring import score_runs
    from datagen.train.arrivals import read_arrival

    refuse_missing_packages(mode)
    fit_on = [str(path) for path in fit or ()]
    errors = arrivals_of([read_arrival(text) for text in arrival or ()])
    checkpoints, run_paths = split_paths(paths)
    runs, models = open_evaluated_runs(run_paths), open_models(checkpoints)
    refuse_seen_houses(runs, models)
    rule = None if heuristic is None else read_heuristic(Path(heuristic), runs, False)
    folder = None if detector is None else Path(detector)
    plain = baseline_methods(baselines, fit_on, folder, rule, seed, runs, False, json=json)
    methods = [*plain.baselines, *models]
    if not methods:
        raise InputError(
            _VERB, "PATH", "no model or baseline given", "Name a checkpoint, or omit --baselines"
        )
    columns = score_runs(runs, methods, seed, json).columns
    loop = plan_loop(
        columns, runs, given, methods, errors, repeats, scenes, mode, seed, str(out / "arrivals")
    )
    processes = len(os.sched_getaffinity(0)) if workers is None else workers
    with interruptible() as stopping, counting("arrivals", json) as seen:
        missing = [(task, len(task.missing())) for task in loop.tasks]
        of = sum(n for _, n in missing)
        todo = [task for task, n in missing if n]
        if not work_through(_VERB, make_arrivals, todo, processes, stopping, lambda done: seen(done, of)):
            print_interrupted("; finished arrivals are kept", sys.argv[1:])
            return 130
    record = loop_record(loop, plain, models, runs, fit_on, bootstrap, seed)
    with whole_file(out / "closed-loop.json") as file:
        file.write(json_text.dumps(record, indent=1, allow_nan=False).encode())
    draw_loop(record, out / "closed-loop.svg")
    if json:
        print_json(record)
        return 0
    print_loop(record, [(name, str(out / f"closed-loop.{name}")) for name in ("json", "svg")])
    return 0

"""`datagen frontier`: compare accuracy with the cost of labels, and choose labels to buy next."""

from __future__ import annotations

import json as json_text
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from datagen.console.command_lines import print_interrupted
from datagen.console.options import AllowIncomplete, AsJson, Whole, refuse_odd_draws
from datagen.console.printing import print_json
from datagen.display.progress import counting
from datagen.schemas.errors import InputError
from datagen.schemas.merged_runs import open_runs
from datagen.schemas.whole_files import whole_file

if TYPE_CHECKING:
    from datagen.frontier.trainings import TrainingTask
    from datagen.train.dataset import SampleStream
    from datagen.train.encoded.runs import EncodedRuns

_SHARES = (0.125, 0.25, 0.5, 1.0)
_MOST_SEEDS, _MOST_WORKERS = 100, 256
_DEAR = ("plan", "sim")


def frontier(
    runs: Annotated[list[str], Parameter(name="RUN...")],
    /,
    *,
    val: Sequence[str],
    test: Sequence[str],
    out: Path,
    prices: Path | None = None,
    target_accuracy: float | None = None,
    budget: str = "1cpu-h",
    shares: Sequence[float] = _SHARES,
    seeds: Whole = 3,
    bootstrap: Whole = 200,
    seed: Whole = 0,
    workers: Whole | None = None,
    allow_incomplete: AllowIncomplete = False,
    json: AsJson = False,
) -> int:
    """Compare the accuracy of models with the cost of their labels, and choose labels to buy next.

    Small models are trained on every label source alone and on dearer labels after cheaper ones, each on
    nested shares of the houses, and are tested within reach. Learning curves of the sources are fitted and
    compared. After Ctrl-C, or with more runs, the same command trains only what is missing.

    For example: datagen frontier runs/heuristic runs/plan --val runs/val --test runs/test --out frontier

    Args:
        runs: Runs to train on, of two or more label sources, or of one.
        val: Runs of plan or sim labels that choose each training's epoch.
        test: Runs of plan or sim labels that models are tested on.
        out: Folder for encodings, trainings, frontier.json and frontier.svg.
        prices: Prices as a TOML file [datagen's own].
        target_accuracy: Balanced accuracy within reach to buy labels for, such as 0.85.
        budget: Budget for the next labels: CPU time (5cpu-h) or money (3usd).
        shares: Shares of each run's houses to train on, ascending; the last is 1.
        seeds: Trainings of each mixture; each seed has its own order of houses.
        bootstrap: Resamples of seeds and scenes.
        seed: Seed of the resamples.
        workers: Training processes [cores].
        allow_incomplete: Accept runs that lack planned samples instead of failing.
    """
    _refuse_odd_options(runs, val, test, target_accuracy, shares, seeds, workers)
    refuse_odd_draws(bootstrap, seed)
    from datagen.frontier.cost_per_label import label_costs
    from datagen.frontier.mixtures import FIDELITY, mixtures_of
    from datagen.frontier.trainings import TrainingTask, make_trainings
    from datagen.jobs.budget_option import budget_cpu_h
    from datagen.reports.prices import read_prices
    from datagen.train.training.launching import interruptible

    priced, cpu_h = read_prices(prices), budget_cpu_h(budget, prices)
    by_source = _by_source(runs)
    for option, paths in (("--val", val), ("--test", test)):
        _refuse_not_dear(paths, option)
    sources = [name for name in FIDELITY if name in by_source]
    costs = label_costs({name: by_source[name] for name in sources}, priced)
    try:
        encoded = _encoded({**by_source, "val": list(val), "test": list(test)}, out, allow_incomplete, json)
    except KeyboardInterrupt:
        print_interrupted("; finished encodings are kept", sys.argv[1:])
        return 130
    folders = {name: str(out / "encodings" / data.key) for name, data in encoded.items()}
    mixtures = mixtures_of(sources, sorted(shares))
    tasks = [TrainingTask(m, k, folders, str(out)) for k in range(seeds) for m in mixtures]
    processes = workers or len(os.sched_getaffinity(0))
    with interruptible() as stopping, counting("trainings", json) as seen:
        if not make_trainings(tasks, processes, stopping, seen):
            print_interrupted("; finished trainings are kept", sys.argv[1:])
            return 130
    record = _report(tasks, encoded["test"], costs, priced, cpu_h, target_accuracy, bootstrap, seed, out)
    record |= {"runs": by_source, "val": list(val), "test": list(test)}
    with whole_file(out / "frontier.json") as file:
        file.write(json_text.dumps(record, indent=1, allow_nan=False).encode())
    if json:
        print_json(record)
        return 0
    from datagen.frontier.frontier_report import print_frontier

    print_frontier(record, [(name, str(out / f"frontier.{name}")) for name in ("json", "svg")])
    return 0


def _report(
    tasks: Sequence[TrainingTask],
    tested: EncodedRuns,
    costs: dict[str, Any],
    priced: Any,
    cpu_h: float,
    target_accuracy: float | None,
    bootstrap: int,
    seed: int,
    out: Path,
) -> dict[str, Any]:
    """Fit the learning curves, draw the figure, and return the JSON document."""
    import numpy as np

    from datagen.frontier.figure import draw_frontier
    from datagen.frontier.frontier_report import frontier_record
    from datagen.frontier.mixtures import Mixture
    from datagen.frontier.points import TestSet, points_of
    from datagen.frontier.study import study
    from datagen.frontier.trainings import TrainingResult, read_result

    results: dict[Mixture, list[TrainingResult]] = {}
    for task in tasks:
        results.setdefault(task.mixture, []).append(read_result(task))
    _, scene = np.unique(tested.scene_of_candidate[tested.in_range], return_inverse=True)
    label = tested.label[tested.in_range] == 1
    if not len(label) or label.all() or not label.any():
        problem = (
            f"{len(label)} candidates within reach, all with one label" if len(label) else "none within reach"
        )
        raise InputError("datagen frontier", "--test", problem, "Name a larger run, of --candidates in-range")
    points = points_of(results, TestSet(label, scene), costs, bootstrap, seed)
    found = study(points, costs, cpu_h, target_accuracy)
    draw_frontier(points, priced.currency, out / "frontier.svg")
    counts = {"candidates": len(label), "scenes": int(scene.max()) + 1, "positives": int(label.sum())}
    return frontier_record(found, priced, cpu_h, {"test_set": counts})


def _encoded(
    paths: dict[str, list[str]], out: Path, allow_incomplete: bool, json: bool
) -> dict[str, EncodedRuns]:
    """Encode the runs of each source, "val" and "test". InputError where val or test shares a house."""
    from datagen.frontier.mixtures import MODEL_CONFIG
    from datagen.train.encoded.runs import encode_runs, encoded_stream
    from datagen.train.models.shared import SharedModel
    from datagen.train.scorers import use_threads
    from datagen.train.splits import refuse_one_class, refuse_shared_houses

    use_threads(1)  # one robot's point cloud is too little work for several threads
    streams: dict[str, SampleStream] = {}
    for name, of_source in paths.items():
        streams[name] = encoded_stream(of_source, allow_incomplete)
        refuse_one_class(streams[name])
    for name, stream in streams.items():
        for judge in ("val", "test"):
            if name not in (judge, "test"):
                refuse_shared_houses(stream, streams[judge])
    found: dict[str, EncodedRuns] = {}
    for name, stream in streams.items():
        with counting(f"scenes of {name} encoded", json, of=stream.n_scenes) as seen:
            found[name] = encode_runs(stream, SharedModel(MODEL_CONFIG), out / "encodings", seen)
    return found


def _by_source(runs: Sequence[str]) -> dict[str, list[str]]:
    """The runs' paths by label source. InputError for merged runs of several, and without a dear source."""
    found: dict[str, list[str]] = {}
    for path in runs:
        sources = sorted({run.manifest.spec.label_source for run in open_runs(path)})
        if len(sources) > 1:
            problem = f"has labels of {' and '.join(sources)}"
            raise InputError(path, "label_source", problem, "Name the runs that were merged")
        found.setdefault(sources[0], []).append(path)
    if not any(source in found for source in _DEAR):
        problem = "all have heuristic labels"
        raise InputError("datagen frontier", "RUN", problem, "Name a run of `datagen submit plan` or sim too")
    return found


def _refuse_not_dear(paths: Sequence[str], option: str) -> None:
    for path in paths:
        for run in open_runs(path):
            if (source := run.manifest.spec.label_source) not in _DEAR:
                fix = f"Name a run of `datagen submit plan` or sim with {option}"
                raise InputError(
                    path, "label_source", f"is {source}: models are judged on plan or sim labels", fix
                )


def _refuse_odd_options(
    runs: Sequence[str],
    val: Sequence[str],
    test: Sequence[str],
    target_accuracy: float | None,
    shares: Sequence[float],
    seeds: int,
    workers: int | None,
) -> None:
    for name, given in (("RUN", runs), ("--val", val), ("--test", test)):
        if not given:
            raise InputError("datagen frontier", name, "is missing", "Name one or more run folders")
    rules = {
        "--target-accuracy": (
            target_accuracy,
            target_accuracy is None or 0.5 < target_accuracy < 1,
            "0.5 to 1",
        ),
        "--shares": (list(shares), _are_shares(shares), "ascending shares above 0 that end with 1"),
        "--seeds": (seeds, 1 <= seeds <= _MOST_SEEDS, f"1 to {_MOST_SEEDS}"),
        "--workers": (workers, workers is None or 1 <= workers <= _MOST_WORKERS, f"1 to {_MOST_WORKERS}"),
    }
    for option, (value, valid, fix) in rules.items():
        if not valid:
            raise InputError("datagen frontier", option, f"{value}", f"Give {fix}")


def _are_shares(shares: Sequence[float]) -> bool:
    ordered = sorted(set(shares))
    return bool(ordered) and ordered == list(shares) and ordered[0] > 0 and ordered[-1] == 1

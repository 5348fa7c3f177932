"""`datagen benchmark`: make the runs of the frozen benchmark, and score methods on them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from datagen.console.command_lines import Interrupted, given_options, prints, words_of
from datagen.console.options import (
    AsJson,
    File,
    PathOrAddress,
    PathsOrAddresses,
    Whole,
    refuse_odd_draws,
    refuse_output,
)
from datagen.console.printing import print_json, print_rows
from datagen.jobs.job import JobOptions
from datagen.jobs.job_report import JobResult, print_job
from datagen.jobs.start_job import absolute_path, absolute_source
from datagen.schemas.errors import InputError
from datagen.schemas.whole_files import whole_file

app = App(name="benchmark", help="Make the runs of the frozen benchmark, and score methods on them.")
Names = Annotated[Sequence[str] | None, Parameter(name="--run", metavar="NAME")]


def print_made(results: list[JobResult], **_: Any) -> int:
    """Return the exit code; each job has printed its own summary."""
    return results[-1].exit_code


@app.command
@prints(print_made)
def make(
    *,
    houses: str,
    objects: str,
    out: PathOrAddress,
    run: Names = None,
    benchmark: File | None = None,
    job: JobOptions = JobOptions(),  # noqa: B008 - immutable
) -> list[JobResult]:
    """Make the runs of the benchmark in OUT, and compare their digests with the frozen ones.

    The same command resumes. Houses, objects and engines must be those that the definition names: the same
    specification gives the same labels on the same platform.

    For example: datagen benchmark make --houses procthor:DIR --objects ycb:DIR --out runs

    Args:
        houses: procthor:DIR with the benchmark's houses.
        objects: ycb:DIR with the benchmark's objects; OUT/objects gets their training and test parts.
        out: Folder for the runs.
        run: Run to make; repeat for more. [default: all]
        benchmark: Definition of another benchmark. [default: the shipped one]
    """
    from datagen.benchmark.definition import read_benchmark
    from datagen.benchmark.frozen_runs import refuse_differing
    from datagen.benchmark.make_runs import divided_sources, make_runs

    if job.detach:
        raise InputError("--detach", "", "is for one run", "Run this command in the background instead")
    job.refuse_bad()
    definition = read_benchmark(None if benchmark is None else Path(benchmark))
    runs = definition.chosen(run or ())
    folder = Path(absolute_path(out))
    given = {"--houses": absolute_source(houses), "--objects": absolute_source(objects), "--out": str(folder)}
    words = ["benchmark", "make", *words_of(given)]
    for name in run or ():
        words += ["--run", name]
    words += words_of({"--benchmark": None if benchmark is None else str(Path(benchmark).absolute())})
    words += words_of(given_options(job))
    sources = divided_sources(houses, objects, folder, runs)
    results: list[JobResult] = []
    try:
        for result in make_runs(runs, sources, folder, job, words):
            results.append(result)
            print_job(result)
            if not result.complete:
                return results
    except Interrupted as stopped:
        print_job(stopped.result)
        raise Interrupted(str(stopped), [*results, stopped.result]) from stopped
    rows: list[tuple[str, str]] = []
    for name, wanted in runs.items():
        refuse_differing(str(folder / name), name, wanted, definition.version)
        rows.append((name, "candidates and labels as frozen" if wanted.digests else "made; not frozen yet"))
    print_rows(f"benchmark {definition.version} in {folder}", rows)
    return results


def print_scores(
    report: dict[str, Any], json: bool, out: Sequence[str | Path] | None = None, **_: Any
) -> int:
    """Print the leaderboard."""
    from datagen.benchmark.leaderboard_tables import print_leaderboard

    if json:
        print_json(report)
        return 0
    print_leaderboard(report)
    if out:
        print_rows("written", [("", str(file)) for file in out])
    return 0


@app.command
@prints(print_scores)
def score(
    methods: Annotated[Sequence[str], Parameter(name="METHOD...")],
    /,
    *,
    runs: PathOrAddress,
    run: Names = None,
    fit: PathsOrAddresses | None = None,
    benchmark: File | None = None,
    bootstrap: Whole = 1000,
    seed: Whole = 0,
    threads: Whole | None = None,
    out: Annotated[Sequence[str | Path] | None, Parameter(metavar="PATH")] = None,
    json: AsJson = False,
) -> dict[str, Any]:
    """Score methods on the benchmark's runs, and print the leaderboard.

    A METHOD is `released`, a checkpoint, a CSV file of scores, the name of a baseline, or module:function,
    whose code is run. A run that is not the benchmark's is refused with its differences.

    For example: datagen benchmark score released mine.csv scalars --runs runs --fit val --out board.html

    Args:
        methods: Methods to compare.
        runs: Folder with the runs of `datagen benchmark make`.
        run: Run to score on; repeat for more. [default: all]
        fit: Run in validation houses to fit baselines on; repeat for more.
        benchmark: Definition of another benchmark. [default: the shipped one]
        bootstrap: Resamples of scenes for each interval.
        seed: Seed of the resamples and of baselines.
        threads: CPU threads of the models. [default: chosen by torch]
        out: File to write, .json or .html; repeat for both.
        json: Print one JSON document, and progress as JSON lines.
    """
    from datagen.benchmark.definition import read_benchmark
    from datagen.benchmark.frozen_runs import refuse_differing
    from datagen.benchmark.leaderboard import leaderboard
    from datagen.benchmark.leaderboard_tables import page_of
    from datagen.benchmark.methods import open_methods, refuse_trained_objects
    from datagen.evaluation_report.evaluated_runs import open_evaluated_runs, refuse_seen_houses
    from datagen.evaluation_report.scoring import score_runs

    files = [Path(file) for file in out or ()]
    for file in files:
        refuse_output(file, "--out", ".json", ".html")
    refuse_odd_draws(bootstrap, seed)
    if threads is not None:
        if not 1 <= threads <= 1024:
            raise InputError("--threads", str(threads), "is not between 1 and 1024", "Give 1 or more")
        from datagen.train.scorers import use_threads

        use_threads(threads)
    definition = read_benchmark(None if benchmark is None else Path(benchmark))
    wanted = definition.chosen(run or ())
    paths = {name: f"{str(runs).rstrip('/')}/{name}" for name in wanted}
    for name, path in paths.items():
        refuse_differing(path, name, wanted[name], definition.version)
    opened = [open_evaluated_runs([path])[0] for path in paths.values()]
    compared = open_methods(methods, [str(path) for path in fit or ()], seed, opened, json)
    refuse_seen_houses(opened, compared, "Train it on runs of the splits train and val alone")
    for (name, path), each in zip(paths.items(), opened, strict=True):
        refuse_trained_objects(path, each, compared, wanted[name].objects == "test")
    gathered = score_runs(opened, compared, seed, json)
    report = leaderboard(
        definition, wanted, gathered, compared, [str(path) for path in fit or ()], bootstrap, seed
    )
    for file in files:
        with whole_file(file, alone=True) as stream:
            if file.suffix.lower() == ".html":
                stream.write(page_of(report).encode())
            else:
                import json as json_format

                stream.write((json_format.dumps(report, indent=1, allow_nan=False) + "\n").encode())
    return report

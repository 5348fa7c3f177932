"""`datagen benchmark`: make the runs of the frozen benchmark, and score methods on them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from datagen.console.command_lines import (
    Interrupted,
    absolute_path,
    absolute_source,
    given_options,
    prints,
    words_of,
)
from datagen.console.options import AsJson, File, PathOrAddress, PathsOrAddresses, Whole
from datagen.console.printing import print_rows
from datagen.evaluation.output import output_file, print_report, write_report
from datagen.jobs.job import JobOptions
from datagen.jobs.job_report import print_job

app = App(name="benchmark", help="Make the runs of the frozen benchmark, and score methods on them.")


@app.command
def make(
    *,
    houses: str,
    objects: str,
    out: Path,
    run: Annotated[Sequence[str] | None, Parameter(metavar="NAME")] = None,
    workers: Whole | None = None,
) -> int:
    """Make the runs of the benchmark in OUT, and compare their digests with the frozen ones.

    The same command resumes. Houses, objects and engines must be those that the definition names: the same
    specification gives the same labels on the same platform. A benchmark.json in OUT is another definition.

    For example: datagen benchmark make --houses procthor:DIR --objects ycb:DIR --out runs

    Args:
        houses: procthor:DIR with the benchmark's houses.
        objects: ycb:DIR with the benchmark's objects; OUT/objects gets their training and test parts.
        out: Folder for the runs.
        run: Run to make; repeat for more. [default: all]
        workers: Worker processes; 0: this process, for debuggers. [default: one per core]
    """
    from datagen.evaluation.benchmark import read_benchmark, refuse_differing
    from datagen.evaluation.benchmark_runs import divided_objects, make_runs

    job_options = JobOptions(workers=workers)
    job_options.refuse_bad()
    folder = Path(absolute_path(out))
    definition = read_benchmark(folder)
    runs = definition.chosen(run or ())
    houses, objects = absolute_source(houses), absolute_source(objects)
    words = ["benchmark", "make", *words_of({"--houses": houses, "--objects": objects, "--out": folder})]
    for name in run or ():
        words += ["--run", name]
    words += words_of(given_options(job_options))
    parts = divided_objects(objects, folder, runs)
    try:
        for result in make_runs(runs, houses, parts, folder, job_options, words):
            if print_job(result):
                return result.exit_code
    except Interrupted as stopped:
        return print_job(stopped.result)
    for name, wanted in runs.items():
        refuse_differing(str(folder / name), name, wanted, definition.version)
    rows = [
        (n, "candidates and labels as frozen" if r.digests else "not frozen yet") for n, r in runs.items()
    ]
    print_rows(f"benchmark {definition.version} in {folder}", rows)
    return 0


@app.command
@prints(print_report)
def score(
    methods: Annotated[Sequence[str], Parameter(name="METHOD...")],
    /,
    *,
    runs: PathOrAddress | None = None,
    fit: PathsOrAddresses | None = None,
    out: File | None = None,
    full: bool = False,
    json: AsJson = False,
) -> dict[str, Any]:
    """Score methods on the benchmark's runs, and print a summary of the report.

    A METHOD is `released`, a checkpoint, a CSV file of scores, or the name of a baseline. A run that is not
    the benchmark's is refused with its differences.

    For example: datagen benchmark score released mine.csv scalars --runs runs --fit val --out board.json

    Args:
        methods: Methods to compare.
        runs: Folder with the runs of `datagen benchmark make`, or a pack; runs that it lacks are not scored.
            [default: the pack that comes with datagen]
        fit: Run in validation houses to fit baselines on; repeat for more.
        out: File to write, FILE.json, with all numbers.
        full: Print all tables and notes.
    """
    from datagen.evaluation.benchmark import (
        present_runs,
        read_benchmark,
        refuse_differing,
        refuse_trained_objects,
        shipped_pack,
    )
    from datagen.evaluation.methods import open_methods, refuse_seen_houses, score_runs
    from datagen.evaluation.report import Part, evaluation_report, parts_by_place, parts_of_grids
    from datagen.evaluation.runs import open_evaluated_runs

    file = output_file(out)
    folder = str(shipped_pack() if runs is None else runs)
    definition = read_benchmark(None if "://" in folder else Path(folder))
    paths = present_runs(folder, definition)
    wanted = {name: definition.runs[name] for name in paths}
    for name, run in wanted.items():
        refuse_differing(paths[name], name, run, definition.version)
    opened = [open_evaluated_runs([path])[0] for path in paths.values()]
    fitted_on = [str(path) for path in fit or ()]
    compared = open_methods(methods, fitted_on, opened, json)
    refuse_seen_houses(opened, compared, "Train it on runs of the splits train and val alone")
    for run, each in zip(wanted.values(), opened, strict=True):
        if run.objects == "test":
            refuse_trained_objects(each, compared)
    columns, seconds = score_runs(opened, compared, json)
    parts: list[Part] = []
    for k, (name, run) in enumerate(wanted.items()):
        part = columns.of_scenes(columns.run == k)
        parts += parts_of_grids(name, part) if run.is_of_grids else [Part(name, part, {"in-range": (k,)})]
    parts += parts_by_place(columns)
    report = evaluation_report(seconds, compared, opened, parts, [Path(p).name for p in fitted_on], {})
    report["runs"] = [{**each, "place": name} for each, name in zip(report["runs"], wanted, strict=True)]
    report["benchmark"] = definition.record(wanted)
    write_report(report, file)
    return report

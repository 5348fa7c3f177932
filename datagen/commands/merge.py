"""`datagen merge`: runs made apart become one."""

from __future__ import annotations

from typing import Annotated, Any

from cyclopts import Parameter

from datagen.console.command_lines import command_line, resumable, words_of
from datagen.console.options import AsJson
from datagen.console.printing import print_json, print_rows, seconds
from datagen.jobs.options import absolute_place
from datagen.reports.accounts import account_for
from datagen.schemas.lineage import lineage_summary
from datagen.schemas.merged import open_runs, wanted
from datagen.schemas.merging import Merge, Result, carry_out, plan_merge
from datagen.schemas.merging.writing import Written
from datagen.schemas.progress import steps
from datagen.schemas.run import Run


def merge(
    runs: Annotated[list[str], Parameter(negative=(), help="Runs made apart, or places of merged ones.")],
    *,
    out: Annotated[str, Parameter(help="The result's folder or s3:// address; what is there is added to.")],
    json: AsJson = False,
) -> int:
    """One run of several: other machines, seeds, houses; partial, overlapping or merged themselves.

    Runs may differ in seed, split, houses, objects and --scenes-from; other differences are named and
    refused, and so are runs that hold other rows of one scene. Files are linked, not copied, wherever shards
    are of one size. Sources stay as they are. The same command again finishes a merge that was cut short.
    """
    words = ["merge", *map(absolute_place, runs), *words_of({"--out": absolute_place(out), "--json": json})]
    with resumable(words):
        commits = sum(len(run.committed()) for place in runs for run in open_runs(place))
        with steps("commits read", commits, json) as step:
            planned = plan_merge(runs, out, step)
        with steps("records written", planned.records, json) as step:
            result = carry_out(planned, step)
    report = merge_report(planned, result)
    if json:
        print_json(report)
    else:
        _print(report)
    return 0


def merge_report(planned: Merge, result: Result) -> dict[str, Any]:
    """What was merged as plain values; times in seconds."""
    parts = open_runs(result.place)
    done = {w.run.storage.url: w for w in result.written}
    books = account_for(parts)
    return {
        "out": result.place.url,
        "labels": wanted(parts).labels,
        "n": wanted(parts).n,
        "sealed": result.sealed,
        "total_wall_s": books.total_wall_s,
        "useful_wall_s": books.useful.wall_s,
        "runs": [_part(run, done.get(run.storage.url)) for run in parts],
    }


def _part(run: Run, written: Written | None) -> dict[str, Any]:
    spec, want = run.manifest.spec, wanted([run])
    return {
        "run": run.storage.url,
        "spec_hash": run.manifest.spec_hash,
        "seed": spec.seed,
        "split": spec.split,
        "houses": spec.houses.kind,
        "n": want.n,
        "labels": want.labels,
        "missing_shards": want.missing,
        "shards": {
            "there_before": written.there if written else len(run.committed()),
            "linked": written.linked if written else 0,
            "cut": written.cut if written else 0,
            "held_more_than_once": written.spare if written else 0,
        },
        "attempts": written.attempts if written else len(run.ledger.attempts()),
        "lineage": lineage_summary(run),
    }


def _print(report: dict[str, Any]) -> None:
    missing = sum(part["missing_shards"] for part in report["runs"])
    state = f"; missing shards: {missing}" if missing else ""
    out = report["out"]
    rows = [
        ("labels", f"{report['labels']:,} of {report['n']:,}{state}"),
        ("cost", f"{seconds(report['total_wall_s'])}, of which {seconds(report['useful_wall_s'])} useful"),
        ("store", f"{report['sealed']}: zarr.open or xarray.open_zarr reads it" if report["sealed"] else "-"),
    ]
    if missing:
        rows.append(("continue with", command_line(["resume", out])))
    print_rows(f"merged: {out}", rows)
    for part in report["runs"]:
        shards = part["shards"]
        told = [f"{shards[k]} {word}" for k, word in _WORDS.items() if shards[k]]
        print_rows(
            f"run {part['spec_hash'][:16]}, seed {part['seed']}, {part['split']} of {part['houses']} houses",
            [
                ("labels", f"{part['labels']:,} of {part['n']:,}"),
                ("shards", ", ".join(told) or "none"),
                *(("from", _origin(origin)) for origin in part["lineage"]),
            ],
        )


_WORDS = {
    "there_before": "there before",
    "linked": "linked",
    "cut": "cut anew",
    "held_more_than_once": "held more than once",
}


def _origin(origin: dict[str, Any]) -> str:
    return (
        f"{origin['address']}: {origin['shards']} shards, made on {origin['platform']}, {origin['created']}"
    )

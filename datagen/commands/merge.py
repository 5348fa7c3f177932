"""`datagen merge`: merge runs that were made separately."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from datagen.console.command_lines import absolute_path, command_line, prints, resumable, words_of
from datagen.console.options import AsJson, PathOrAddress
from datagen.console.printing import print_json, print_rows, summary_of_stored
from datagen.display.progress import steps
from datagen.jobs.job_report import readable_by
from datagen.schemas.merging import MergePlan, MergeResult, WrittenPart, merge_runs, plan_merge
from datagen.schemas.run import Run, label_counts, open_runs

_WORDS = {"there_before": "merged before", "copied": "copied", "held_more_than_once": "duplicates"}


def print_merged(report: dict[str, Any], json: bool, **_: Any) -> int:
    """Print the report of a merge."""
    with summary_of_stored():
        if json:
            print_json(report)
        else:
            _print_rows(report)
    return 0


def _print_rows(report: dict[str, Any]) -> None:
    missing = sum(part["missing_shards"] for part in report["runs"])
    state = f"; missing shards: {missing}" if missing else ""
    out = report["out"]
    rows = [
        ("labels", f"{report['labels']:,} of {report['n']:,}{state}"),
        ("store", readable_by(report["sealed"]) if report["sealed"] else "-"),
    ]
    if missing:
        rows.append(("resume with", command_line(["resume", out])))
    print_rows(f"merged: {out}", rows)
    for part in report["runs"]:
        counts = [f"{part['shards'][k]} {word}" for k, word in _WORDS.items() if part["shards"][k]]
        shards = ("shards", ", ".join(counts) or "none")
        title = (
            f"run {part['spec_hash'][:16]}, seed {part['seed']}, {part['split']} of {part['houses']} houses"
        )
        print_rows(title, [("labels", f"{part['labels']:,} of {part['n']:,}"), shards])


@prints(print_merged)
def merge(
    runs: Annotated[Sequence[str | Path], Parameter(name="RUN...")],
    /,
    *,
    out: PathOrAddress,
    json: AsJson = False,
) -> dict[str, Any]:
    """Merge runs into one: from several machines, seeds or houses; partial, overlapping or merged ones too.

    Runs may differ in seed, split, houses, objects and --scenes-from; other differences are refused, as are
    runs with different rows for the same scene. Shards are copied. The merged runs stay unchanged. After an
    interruption, run the same command again.

    For example: datagen merge runs/a runs/b --out runs/all

    Args:
        runs: Runs, or merged runs, to merge.
        out: Folder or s3:// address of the result, which may exist.

    Returns:
        Labels, shards and origin of each part, as `datagen merge --json` prints them.

    Raises:
        InputError: The runs cannot be merged, or one is damaged.

    Examples:
        >>> merged = datagen.merge([run, other], out=folder / "merged")
        >>> merged["labels"], len(merged["runs"])
        (32, 2)
    """
    runs, out = [str(run) for run in runs], str(out)
    words = ["merge", *map(absolute_path, runs), *words_of({"--out": absolute_path(out), "--json": json})]
    with resumable(words):
        commits = sum(len(run.committed()) for path in runs for run in open_runs(path))
        with steps("commits read", commits, json) as step:
            planned = plan_merge(runs, out, step)
        with steps("records written", planned.records, json) as step:
            result = merge_runs(planned, step)
    return merge_report(planned, result)


def merge_report(planned: MergePlan, result: MergeResult) -> dict[str, Any]:
    """Return what was merged as plain values."""
    parts = open_runs(result.storage)
    done = {w.run.storage.url: w for w in result.written}
    counts = label_counts(parts)
    return {
        "out": result.storage.url,
        "labels": counts.labels,
        "n": counts.n,
        "sealed": result.sealed,
        "runs": [_part(run, done.get(run.storage.url)) for run in parts],
    }


def _part(run: Run, written: WrittenPart | None) -> dict[str, Any]:
    spec, counts = run.manifest.spec, label_counts([run])
    return {
        "run": run.storage.url,
        "spec_hash": run.manifest.spec_hash,
        "seed": spec.seed,
        "split": spec.split,
        "houses": spec.houses.kind,
        "n": counts.n,
        "labels": counts.labels,
        "missing_shards": counts.missing,
        "shards": {
            "there_before": written.there if written else len(run.committed()),
            "copied": written.copied if written else 0,
            "held_more_than_once": written.spare if written else 0,
        },
    }

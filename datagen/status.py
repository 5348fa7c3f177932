"""`datagen status`: how far a run is, and what failed."""

from __future__ import annotations

from collections import Counter
from typing import Annotated, Any

from cyclopts import Parameter

from datagen.console import print_json, print_rows
from schemas.index import Heads
from schemas.run import Run
from schemas.seal import sealed_root
from schemas.shard_ranges import ShardRanges


def status(
    run: Annotated[str, Parameter(help="The run's folder.")],
    *,
    json: Annotated[bool, Parameter(negative=(), help="Print one JSON document.")] = False,
) -> int:
    """How far a run is: shards, labels, failed attempts by cause, quarantine."""
    report = status_report(Run.open(run))
    if json:
        print_json(report)
    else:
        _print(run, report)
    return 0


def status_report(run: Run) -> dict[str, Any]:
    """The state of a run as plain values."""
    heads, n = Heads(run), run.n
    planned, committed = ShardRanges.of(range(run.layout.shards_for(n))), ShardRanges.of(heads.shards)
    quarantined = run.quarantined()
    labels = labels_made = positives = 0
    winners: set[str] = set()
    for commit in heads.commits():
        labels += run.layout.rows_wanted(commit.shard, n)[1]
        labels_made += commit.samples
        positives += commit.positives
        winners.add(commit.attempt)
    outcomes: Counter[str] = Counter()
    causes: Counter[str] = Counter()
    for entry in heads.ends():
        outcomes[entry.outcome] += 1
        if entry.cause:
            causes[f"{entry.outcome}: {entry.cause}"] += 1
    unfinished = {start.attempt for start in heads.unfinished()} - winners
    root, absent = sealed_root(run.storage), planned.without(committed)
    part = root.part(run.manifest.spec_hash) if root else None
    return {
        "run": run.storage.url,
        "label_source": run.manifest.spec.label_source,
        "spec_hash": run.manifest.spec_hash,
        "scenes_from": run.manifest.sources.get("scenes_from"),
        "created": run.manifest.created,
        "n": n,
        "labels": labels,
        # Commits count whole shards, and so more than n where the last one is cut.
        "labels_made": labels_made,
        "positives": positives,
        "shards": {
            "planned": len(planned),
            "committed": len(planned) - len(absent),
            "quarantined": sorted(quarantined),
            "missing": len(absent.without(ShardRanges.of(quarantined))),
        },
        "attempts": dict(sorted(outcomes.items())),
        "attempts_without_end": len(unfinished),
        "causes": dict(causes.most_common(20)),
        # An older seal, of a shorter run or with fewer shards, does not count.
        "sealed": part is not None and part.n == n and absent == part.missing_shards,
        "sealed_labels": part.n if part else None,
        "complete": not absent,
    }


def _seal(report: dict[str, Any]) -> str:
    if report["sealed"]:
        return "yes, data.zarr"
    if report["sealed_labels"] is None:
        return "no"
    return f"data.zarr is older ({report['sealed_labels']:,} labels): submit the run again to seal it anew"


def _print(place: str, report: dict[str, Any]) -> None:
    shards = report["shards"]
    state = "complete" if report["complete"] else f"{shards['missing']} shards to make"
    if shards["quarantined"]:
        state += f", {len(shards['quarantined'])} in quarantine: {shards['quarantined'][:10]}"
    attempts = ", ".join(f"{outcome} {count}" for outcome, count in report["attempts"].items()) or "none"
    rows = [
        ("labels", f"{report['labels']:,} of {report['n']:,} ({report['label_source']})"),
        ("shards", f"{shards['committed']} of {shards['planned']} committed; {state}"),
        ("attempts", attempts),
        ("sealed", _seal(report)),
        ("specification", report["spec_hash"][:16]),
        ("created", report["created"]),
    ]
    if report["scenes_from"]:
        rows.append(("scenes from", report["scenes_from"]))
    if report["attempts_without_end"]:
        rows.insert(3, ("without end", f"{report['attempts_without_end']} attempts run now, or were lost"))
    print_rows(f"run {place}", rows)
    if report["causes"]:
        print_rows(
            "causes", [(cause, str(n)) for cause, n in report["causes"].items()], ("cause", "attempts")
        )

"""`datagen status`: how far a run is, and what failed."""

from __future__ import annotations

from collections import Counter
from typing import Annotated, Any

from cyclopts import Parameter

from datagen.console import print_json, print_rows
from schemas.run import Run
from schemas.seal import sealed_root


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
    planned, committed, quarantined = run.planned(), run.committed(), run.quarantined()
    commits = list(run.commits())
    outcomes: Counter[str] = Counter()
    causes: Counter[str] = Counter()
    for entry in run.ledger.ends():
        outcomes[entry.outcome] += 1
        if entry.cause:
            causes[f"{entry.outcome}: {entry.cause}"] += 1
    unfinished = {start.attempt for start in run.ledger.unfinished()} - {c.attempt for c in commits}
    done = [c for c in commits if c.shard in planned]
    root, absent = sealed_root(run.storage), sorted(set(planned) - committed)
    part = root.part(run.manifest.spec_hash) if root else None
    return {
        "run": run.storage.url,
        "label_source": run.manifest.spec.label_source,
        "spec_hash": run.manifest.spec_hash,
        "scenes_from": run.manifest.sources.get("scenes_from"),
        "created": run.manifest.created,
        "n": run.n,
        "labels": sum(run.layout.rows_wanted(c.shard, run.n)[1] for c in done),
        # Commits count whole shards, and so more than n where the last one is cut.
        "labels_made": sum(c.samples for c in commits),
        "positives": sum(c.positives for c in commits),
        "shards": {
            "planned": len(planned),
            "committed": len(committed & set(planned)),
            "quarantined": sorted(quarantined),
            "missing": len(planned) - len(committed & set(planned)) - len(quarantined & set(planned)),
        },
        "attempts": dict(sorted(outcomes.items())),
        "attempts_without_end": len(unfinished),
        "causes": dict(causes.most_common(20)),
        # An older seal, of a shorter run or with fewer shards, does not count.
        "sealed": part is not None and (part.n, part.missing_shards) == (run.n, absent),
        "sealed_labels": part.n if part else None,
        "complete": len(committed & set(planned)) == len(planned),
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

"""Status of runs as plain values: sums over commits and ledger, from their summaries."""

from __future__ import annotations

from collections import Counter
from typing import Any

from datagen.schemas.quarantine import lifted_records
from datagen.schemas.run import Run, open_runs
from datagen.schemas.run_records import StoreRecord
from datagen.schemas.sealing import store_record
from datagen.schemas.shard_ranges import ShardRanges
from datagen.schemas.storage import Storage

_SHOWN = 20  # causes and stacks


def runs_report(storage: Storage, stacks: bool = False) -> dict[str, Any]:
    """Return the status of a run, or of merged runs: their sums, and each under `parts`."""
    runs, store = open_runs(storage), store_record(storage)
    reports = [status_report(run, store, stacks) for run in runs]
    return reports[0] if len(reports) == 1 else _sum(storage, reports)


def status_report(run: Run, store: StoreRecord | None = None, stacks: bool = False) -> dict[str, Any]:
    """Return the status of a run. `store` is the one that holds it, by default its own."""
    n = run.n
    planned, committed = run.planned(n), ShardRanges.of(run.committed())
    quarantine = run.quarantine_records()
    quarantined = [record.shard for record in quarantine]
    labels = labels_made = positives = 0
    winners: set[str] = set()
    for commit in run.commits():
        labels += run.rows_of(commit.shard, n).samples
        labels_made += commit.samples
        positives += commit.positives
        winners.add(commit.attempt)
    outcomes: Counter[str] = Counter({"committed": len(winners)} if winners else {})
    causes: Counter[str] = Counter()
    examples: dict[str, str] = {}  # an attempt of each cause
    for entry in run.ledger.ends():
        outcomes[entry.outcome] += 1
        if entry.cause:
            cause = f"{entry.outcome}: {entry.cause}"
            causes[cause] += 1
            examples.setdefault(cause, entry.attempt)
    store = store or store_record(run.storage)
    absent, part = planned.without(committed), store.part_of(run.manifest) if store else None
    common = dict(causes.most_common(_SHOWN))
    report: dict[str, Any] = {
        "run": run.storage.url,
        "label_source": run.manifest.spec.label_source,
        "spec_hash": run.manifest.spec_hash,
        "made_from": run.manifest.made_from,
        "scenes_from": run.manifest.sources.get("scenes_from"),
        "created": run.manifest.created,
        "n": run.samples_wanted(n),
        "labels": labels,
        # Commits count whole shards, hence more than n where the last one is cut.
        "labels_made": labels_made,
        "positives": positives,
        "shards": {
            "planned": len(planned),
            "committed": len(planned) - len(absent),
            "quarantined": quarantined,
            "missing": len(absent.without(ShardRanges.of(quarantined))),
        },
        "attempts": dict(sorted(outcomes.items())),
        "attempts_without_end": len(run.ledger.unfinished(winners)),
        "causes": common,
        "quarantine": [
            {
                "shard": record.shard,
                "attempts": len(record.attempts),
                "cause": record.causes[-1] if record.causes else "",
            }
            for record in quarantine
        ],
        "taken_out_of_quarantine": len(lifted_records(run)),
        "store": store.name if store else None,
        # A store of a shorter run or of fewer shards does not count.
        "sealed": part is not None and part.n == n and absent.ranges == part.missing,
        "sealed_labels": part.samples if part else None,
        "complete": not absent,
    }
    if stacks:
        ends = {cause: run.ledger.end_of(examples[cause]) for cause in common}
        report["stacks"] = {cause: end.stack for cause, end in ends.items() if end is not None and end.stack}
    return report


def _sum(storage: Storage, parts: list[dict[str, Any]]) -> dict[str, Any]:
    total: dict[str, Any] = {
        "run": storage.url,
        "label_source": parts[0]["label_source"],
        "spec_hash": "",
        "made_from": "; ".join(dict.fromkeys(part["made_from"] for part in parts)),
        "scenes_from": None,
        "created": min(part["created"] for part in parts),
        "complete": all(part["complete"] for part in parts),
        "sealed": all(part["sealed"] for part in parts),
        "store": parts[0]["store"],
    }
    for key in ("n", "labels", "labels_made", "positives", "attempts_without_end", "taken_out_of_quarantine"):
        total[key] = sum(part[key] for part in parts)
    for key in ("attempts", "causes"):
        counts = sum((Counter[str](part[key]) for part in parts), Counter[str]())
        total[key] = dict(counts.most_common(_SHOWN))
    shards = [part["shards"] for part in parts]
    counted = {key: sum(s[key] for s in shards) for key in ("planned", "committed", "missing")}
    # A shard's number is ambiguous without its part.
    quarantined = [f"{number}:{shard}" for number, s in enumerate(shards) for shard in s["quarantined"]]
    total["shards"] = counted | {"quarantined": quarantined}
    total["quarantine"] = [
        q | {"shard": f"{number}:{q['shard']}"}
        for number, part in enumerate(parts)
        for q in part["quarantine"]
    ]
    known = [part["sealed_labels"] for part in parts if part["sealed_labels"] is not None]
    total["sealed_labels"] = sum(known) if known else None
    if "stacks" in parts[0]:
        total["stacks"] = {cause: stack for part in parts for cause, stack in part["stacks"].items()}
    return total | {"parts": parts}

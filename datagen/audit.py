"""`datagen audit`: what labels cost, and what the paper's schedule would cost here."""

from __future__ import annotations

from typing import Annotated, Any

from cyclopts import Parameter

from datagen.accounts import Account, Books, account_for
from datagen.console import print_json, print_rows, seconds, size
from schemas.cost import STAGES
from schemas.errors import InputError
from schemas.run import Run

# GBPP: 180,000 distance-visibility labels in under three days on one RTX A5000.
PAPER_LABELS = 180_000
PAPER_HEURISTIC_DAYS = 3.0


def audit(
    runs: Annotated[list[str], Parameter(negative=(), help="Runs of one label source.")],
    *,
    json: Annotated[bool, Parameter(negative=(), help="Print one JSON document.")] = False,
) -> int:
    """What labels cost: seconds per label by stage, waste, and a projection to 180,000.

    Seconds are summed over workers: two workers that are busy for a minute cost two minutes.
    """
    if not runs:
        raise InputError("datagen audit", "RUN", "no run is named", "Name one or more run folders")
    opened = [Run.open(place) for place in runs]
    sources = sorted({run.manifest.spec.label_source for run in opened})
    if len(sources) > 1:
        raise InputError(
            "datagen audit",
            "RUN",
            f"runs of several label sources ({', '.join(sources)})",
            "Audit each alone",
        )
    report = audit_report(account_for(opened), sources[0])
    if json:
        print_json(report)
    else:
        _print(report)
    return 0


def audit_report(books: Books, source: str) -> dict[str, Any]:
    """The audit as plain values; times in seconds, sizes in bytes."""
    labels = books.labels
    stages: dict[str, dict[str, float]] = {
        stage: {"wall_s": books.useful.stage_wall_s[stage], "cpu_s": books.useful.stage_cpu_s[stage]}
        for stage in STAGES
        if stage in books.useful.stage_wall_s
    }
    stages["other"] = {
        "wall_s": books.useful.unnamed_wall_s,
        "cpu_s": max(0.0, books.useful.cpu_s - sum(books.useful.stage_cpu_s.values())),
    }
    waste = {outcome: _account(account) for outcome, account in sorted(books.waste.items())}
    per_label_s = books.total_wall_s / labels if labels else None
    return {
        "label_source": source,
        "labels": labels,
        "positives": books.positives,
        "positive_share": books.positives / labels if labels else None,
        "scenes": books.scenes,
        "redraws": dict(sorted(books.redraws.items())),
        "useful": _account(books.useful),
        "stages": stages,
        "waste": waste,
        "waste_share": 1 - books.useful.wall_s / books.total_wall_s if books.total_wall_s else None,
        "attempts_running": books.running,
        "wall_s_per_label": per_label_s,
        "bytes_per_label": books.useful.written_bytes / labels if labels else None,
        "projection": {
            "labels": PAPER_LABELS,
            "worker_days": per_label_s * PAPER_LABELS / 86400 if per_label_s is not None else None,
            "paper_days": PAPER_HEURISTIC_DAYS,
            "bytes": books.useful.written_bytes / labels * PAPER_LABELS if labels else None,
        },
        "machines": dict(books.machines),
    }


def _account(account: Account) -> dict[str, Any]:
    return {
        "attempts": account.attempts,
        "without_account": account.unaccounted,
        "wall_s": account.wall_s,
        "cpu_s": account.cpu_s,
        "gpu_s": sum(account.stage_gpu_s.values()),
        "written_bytes": account.written_bytes,
        "peak_rss_bytes": account.peak_rss_bytes,
    }


def _print(report: dict[str, Any]) -> None:
    labels, useful = report["labels"], report["useful"]
    if not labels:
        print_rows("audit", [("labels", "none committed yet")])
        return
    redraws = ", ".join(f"{cause} {count}" for cause, count in report["redraws"].items()) or "none"
    print_rows(
        f"audit of {report['label_source']} labels",
        [
            ("labels", f"{labels:,} in {report['scenes']:,} scenes"),
            ("positive", f"{report['positives']:,} ({100 * report['positive_share']:.1f}%)"),
            ("redraws", redraws),
            ("worker time", f"{seconds(useful['wall_s'])} wall, {seconds(useful['cpu_s'])} CPU"),
            (
                "per label",
                f"{1000 * report['wall_s_per_label']:.3f} ms, {report['bytes_per_label']:.0f} bytes",
            ),
            ("peak memory", size(useful["peak_rss_bytes"])),
            ("machines", "; ".join(report["machines"])),
        ],
    )
    whole = useful["wall_s"]
    print_rows(
        "where the time goes",
        [
            (
                stage,
                f"{1000 * spent['wall_s'] / labels:.3f}",
                f"{1000 * spent['cpu_s'] / labels:.3f}",
                f"{100 * spent['wall_s'] / whole:.1f}%",
            )
            for stage, spent in report["stages"].items()
        ],
        ("stage", "wall ms/label", "CPU ms/label", "share"),
    )
    waste = [
        (outcome, str(account["attempts"]), seconds(account["wall_s"]), str(account["without_account"]))
        for outcome, account in report["waste"].items()
    ]
    if waste:
        print_rows("waste", waste, ("outcome", "attempts", "wall", "without account"))
    projection = report["projection"]
    print_rows(
        f"projection to {projection['labels']:,} labels",
        [
            ("this machine", f"{projection['worker_days']:.4f} worker-days, {size(projection['bytes'])}"),
            ("the paper", f"{projection['paper_days']:.0f} GPU-days (RTX A5000, an upper bound it states)"),
            ("ratio", f"{projection['paper_days'] / projection['worker_days']:.0f} times fewer days"),
            ("waste", f"{100 * report['waste_share']:.1f}% of the time paid"),
        ],
    )

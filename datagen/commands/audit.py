"""`datagen audit`: the cost of labels, its projection to the paper's 180,000, and their agreement."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from datagen.console.options import AsJson
from datagen.console.printing import print_json
from datagen.reports.agreement import common_candidates, compare, join_labelled, outcome_report, read_labelled
from datagen.reports.audit_tables import print_pair, print_ratios, print_source
from datagen.reports.specification_summary import is_disturbed, made_from
from datagen.reports.spending import Account, Spending, account_for
from datagen.schemas.cost import STAGES
from datagen.schemas.errors import InputError
from datagen.schemas.merged_runs import open_runs
from datagen.schemas.run import Run
from datagen.schemas.specification import Specification

# GBPP: 180,000 distance-visibility labels in under three days on one RTX A5000, and over three weeks
# for as many simulated ones.
PAPER_LABELS = 180_000
PAPER_DAYS = {"heuristic": 3.0, "sim": 21.0}

# In ascending fidelity: the later of two is the reference for the earlier.
_FIDELITY = ("heuristic", "plan", "sim")


def audit(
    runs: Annotated[list[str], Parameter(name="RUN...")],
    /,
    *,
    candidates: Literal["grid", "clear", "in-range"] = "grid",
    json: AsJson = False,
) -> int:
    """Show the cost of labels by stage, the waste, and a projection to 180,000 labels.

    Seconds are summed over workers: two workers that are busy for a minute cost two minutes. Runs with
    labels of the same candidates (--scenes-from) are compared pair by pair.

    For example: datagen audit runs/first

    Args:
        runs: Runs of one or several label sources.
        candidates: Candidates whose outcomes and agreement are counted; grid: all.
    """
    if not runs:
        raise InputError("datagen audit", "RUN", "is missing", "Name one or more run folders")
    opened = [run for place in runs for run in open_runs(place)]
    by_source: dict[str, list[Run]] = {}
    for run in sorted(opened, key=lambda run: _fidelity(run.manifest.spec)):
        by_source.setdefault(run.manifest.spec.label_source, []).append(run)
    sources = [
        audit_report(account_for(group), source)
        | {"made_from": made_from(run.manifest for run in group)}
        | _outcomes(group, candidates)
        for source, group in by_source.items()
    ]
    costs = ratios(sources)
    compared = pairs([run for group in by_source.values() for run in group], candidates)
    if json:
        print_json({"candidates": candidates, "sources": sources, "ratios": costs, "pairs": compared})
        return 0
    for source in sources:
        print_source(source, candidates)
    if costs:
        print_ratios(costs)
    for pair in compared:
        print_pair(pair)
    return 0


def ratios(sources: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return, for every two label sources, the cost of a label of the second divided by that of the first."""
    return [
        {
            "source": second["label_source"],
            "over": first["label_source"],
            "cost_ratio": second["wall_s_per_label"] / first["wall_s_per_label"],
        }
        for first, second in combinations(sources, 2)
        if first["wall_s_per_label"] and second["wall_s_per_label"]
    ]


def pairs(runs: Sequence[Run], candidates: str) -> list[dict[str, Any]]:
    """Return the agreement of every two runs with labels of the same candidates; the later is the reference.

    The cost of a correct label of the first run is its cost per label divided by its accuracy.
    """
    found: list[dict[str, Any]] = []
    for first, second in combinations(runs, 2):
        specs = first.manifest.spec, second.manifest.spec
        if specs[0].scenes_hash != specs[1].scenes_hash or specs[0] == specs[1]:
            continue
        labels = read_labelled(first), read_labelled(second)
        if labels[0] is None or labels[1] is None:
            continue
        said, true = common_candidates(labels[0], labels[1])
        rows = true.is_in(candidates)
        compared = compare(said.at(rows), true.at(rows))
        costs_s = [account_for([run]).wall_s_per_label for run in (first, second)]
        accuracy = compared["accuracy"]
        found.append(
            {
                "said_by": _who(first),
                "true_by": _who(second),
                "candidates": candidates,
                **compared,
                "wall_s_per_correct_label": {
                    "said_by": costs_s[0] / accuracy if costs_s[0] and accuracy else None,
                    "true_by": costs_s[1],
                },
            }
        )
    return found


def _fidelity(spec: Specification) -> tuple[int, bool]:
    known = spec.label_source in _FIDELITY
    return (_FIDELITY.index(spec.label_source) if known else 0, is_disturbed(spec))


def _who(run: Run) -> dict[str, Any]:
    spec = run.manifest.spec
    return {"run": run.storage.url, "label_source": spec.label_source, "disturbed": is_disturbed(spec)}


def _outcomes(runs: Sequence[Run], candidates: str) -> dict[str, Any]:
    """Counts of outcomes, for runs whose labels have one; empty for others."""
    if not any(f.name == "outcome" for f in runs[0].schema.sample_fields):
        return {}
    read = [labelled for run in runs if (labelled := read_labelled(run)) is not None]
    if not read:
        return {}
    labelled = join_labelled(read)
    return {"outcomes": outcome_report(labelled.at(labelled.is_in(candidates)))}


def audit_report(spending: Spending, source: str) -> dict[str, Any]:
    """Return the audit as plain values; times in seconds, sizes in bytes."""
    labels = spending.labels
    stages: dict[str, dict[str, float]] = {
        stage: {"wall_s": spending.useful.stage_wall_s[stage], "cpu_s": spending.useful.stage_cpu_s[stage]}
        for stage in STAGES
        if stage in spending.useful.stage_wall_s
    }
    stages["other"] = {
        "wall_s": spending.useful.unnamed_wall_s,
        "cpu_s": max(0.0, spending.useful.cpu_s - sum(spending.useful.stage_cpu_s.values())),
    }
    waste = {outcome: _account(account) for outcome, account in sorted(spending.waste.items())}
    per_label_s = spending.wall_s_per_label
    return {
        "label_source": source,
        "labels": labels,
        "positives": spending.positives,
        "positive_share": spending.positives / labels if labels else None,
        "scenes": spending.scenes,
        "redraws": dict(sorted(spending.redraws.items())),
        "useful": _account(spending.useful),
        "relabelled_from": {f"{clock}_s": spending.useful.source_s[clock] for clock in ("wall", "cpu")},
        "stages": stages,
        "waste": waste,
        "waste_share": 1 - spending.useful.wall_s / spending.total_wall_s if spending.total_wall_s else None,
        "attempts_running": spending.running,
        "wall_s_per_label": per_label_s,
        "bytes_per_label": spending.useful.written_bytes / labels if labels else None,
        "projection": {
            "labels": PAPER_LABELS,
            "worker_days": per_label_s * PAPER_LABELS / 86400 if per_label_s is not None else None,
            "paper_days": PAPER_DAYS.get(source),
            "bytes": spending.useful.written_bytes / labels * PAPER_LABELS if labels else None,
        },
        "machines": dict(spending.machines),
    }


def _account(account: Account) -> dict[str, Any]:
    names = ("attempts", "without_account", "wall_s", "cpu_s", "written_bytes", "peak_rss_bytes")
    return {name: getattr(account, name) for name in names}

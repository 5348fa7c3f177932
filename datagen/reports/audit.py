"""The audit of runs as plain values: cost, waste, sums, and agreement."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

from datagen.reports.agreement import join_labelled, outcome_report, read_labelled
from datagen.reports.label_costs import PAPER_LABELS, audit_report, costs_of_runs, paper_costs, source_costs
from datagen.reports.ledger_balance import Balance, balance
from datagen.reports.paired_runs import AuditedRun, correct_labels, fidelity, pairs
from datagen.reports.prices import Prices
from datagen.reports.scene_intervals import METHOD
from datagen.reports.spending import account_for
from datagen.schemas.run import Run


def audit_runs(runs: Sequence[Run], candidates: str, prices: Prices) -> dict[str, Any]:
    """Return the audit of runs; times in seconds, sizes in bytes, money in the currency of the prices.

    `candidates` is a set of CANDIDATE_SETS, for outcomes and agreement. Runs are ordered by fidelity. Raises
    InputError for a damaged record or shard.
    """
    ordered = sorted(runs, key=lambda run: fidelity(run.manifest.spec))
    spendings = [account_for([run]) for run in ordered]
    audited = [
        AuditedRun(run, read_labelled(run), cost, spending.wall_s_per_label)
        for run, cost, spending in zip(ordered, costs_of_runs(ordered, spendings), spendings, strict=True)
    ]
    by_source: dict[str, list[AuditedRun]] = {}
    for one in audited:
        by_source.setdefault(one.run.manifest.spec.label_source, []).append(one)
    sources = [_source(source, group, candidates, prices) for source, group in by_source.items()]
    return {
        "candidates": candidates,
        "intervals": METHOD,
        "prices": prices.record(),
        "balance": balance_record(balance(ordered)),
        "sources": sources,
        "ratios": ratios(sources),
        "paper": {"labels": PAPER_LABELS, "by_source": paper_costs(prices)},
        "correct_labels": correct_labels(audited, prices),
        "pairs": pairs(audited, candidates),
    }


def _source(source: str, group: Sequence[AuditedRun], candidates: str, prices: Prices) -> dict[str, Any]:
    """Sums, costs and outcomes of the runs of one label source."""
    spending = account_for(one.run for one in group)
    read = [one.labelled for one in group if one.labelled is not None]
    labelled = join_labelled(read) if read else None
    report = audit_report(spending, source, prices)
    report |= source_costs(spending, [one.cost for one in group], labelled, prices)
    report["made_from"] = "; ".join(dict.fromkeys(one.run.manifest.made_from for one in group))
    if labelled is not None and labelled.outcome is not None:
        report["outcomes"] = outcome_report(labelled.at(labelled.is_in(candidates)))
    return report


def ratios(sources: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return, for every two label sources, the cost of a label of the second divided by that of the first.

    For any label in worker time, without borrowed scenes; for one within reach in core time, with them.
    """
    found: list[dict[str, Any]] = []
    for first, second in combinations(sources, 2):
        if not (first["wall_s_per_label"] and second["wall_s_per_label"]):
            continue
        near = [source["cost_per"]["label_within_reach"] for source in (first, second)]
        found.append(
            {
                "source": second["label_source"],
                "over": first["label_source"],
                "cost_ratio": second["wall_s_per_label"] / first["wall_s_per_label"],
                "cost_ratio_within_reach": near[1]["core_s"] / near[0]["core_s"]
                if all(near) and near[0]["core_s"]
                else None,
            }
        )
    return found


def balance_record(sums: Balance) -> dict[str, Any]:
    """The sums of ledgers as plain values, with the findings of records that differ."""
    return {
        "exact": sums.is_exact,
        **{name: getattr(sums, name) for name in ("ledger_s", "commits_s", "waste_s", "difference_s")},
        "findings": [
            {"file": f.key, "kind": f.kind, "problem": f.problem, "fix": f.fix, "shard": f.shard}
            for f in sums.findings
        ],
    }

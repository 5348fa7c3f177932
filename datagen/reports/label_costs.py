"""The cost of labels: seconds and money of a label source, by stage, cause of waste and kind of label.

CPU seconds are measured per shard, not per candidate. The whole cost of a run, waste included, is divided by
the number of labels of a kind. Candidates where the base collides or beyond reach cost almost nothing and
have almost no information: labels within reach carry the whole cost.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from datagen.reports.agreement import Labelled
from datagen.reports.prices import Prices, read_prices
from datagen.reports.spending import QUARANTINED, Account, Spending
from datagen.schemas.run import Run
from datagen.schemas.run_records import STAGES

# GBPP: 180,000 distance-visibility labels in under three days on one RTX A5000, and over three weeks
# for as many simulated ones.
PAPER_LABELS = 180_000
PAPER_DAYS = {"heuristic": 3.0, "sim": 21.0}
_DAY_S = 86400.0

SCENE_STAGES = ("draw", "settle", "observe")
_MOST_CAUSES = 10


@dataclass(frozen=True)
class Spent:
    """Seconds and stored bytes. `core_s`: CPU seconds, and wall seconds of killed attempts."""

    wall_s: float = 0.0
    core_s: float = 0.0
    gpu_s: float = 0.0
    stored_bytes: int = 0

    def __add__(self, other: Spent) -> Spent:
        return Spent(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))

    def money(self, prices: Prices) -> float:
        """Money in the currency of the prices."""
        return prices.cost_of(self.core_s, self.gpu_s, self.stored_bytes)


@dataclass(frozen=True)
class RunCost:
    """The cost of a run's labels: committed attempts, waste, files that it relabelled, and borrowed scenes.

    A run with --scenes-from labels scenes that another run made. `scenes` is their cost in that run: the
    stages draw, settle and observe, rejected tries included, in proportion to the number of scenes; None
    where that run is not among those audited.
    """

    committed: Spent
    waste: Spent
    relabelled: Spent
    scenes: Spent | None

    @property
    def own(self) -> Spent:
        """The cost of this run alone."""
        return self.committed + self.waste

    @property
    def total(self) -> Spent:
        """The whole cost of its labels; without borrowed scenes where their cost is unknown."""
        return self.committed + self.waste + self.relabelled + (self.scenes or Spent())


def costs_of_runs(runs: Sequence[Run], spendings: Sequence[Spending]) -> list[RunCost]:
    """The cost of each of these runs, from its sums (`account_for([run])`)."""
    known = {run.manifest.spec_hash: spending for run, spending in zip(runs, spendings, strict=True)}
    return [_cost_of(run, spending, known) for run, spending in zip(runs, spendings, strict=True)]


def _cost_of(run: Run, spending: Spending, known: Mapping[str, Spending]) -> RunCost:
    """The cost of one run; `known` has sums by specification hash, to find borrowed scenes."""
    useful, spec = spending.useful, run.manifest.spec
    relabelled = Spent(useful.source_s["wall"], useful.source_s["cpu"])
    scenes: Spent | None = Spent()
    if spec.scenes_from is not None and not relabelled.wall_s:
        maker = known.get(spec.scenes_hash)
        scenes = _scenes_of(maker, spending.scenes) if maker else None
    waste = sum((_spent(account) for account in spending.waste.values()), Spent())
    return RunCost(_spent(useful, useful.written_bytes), waste, relabelled, scenes)


def _spent(account: Account, stored_bytes: int = 0) -> Spent:
    return Spent(account.wall_s, account.core_s, account.gpu_s or 0.0, stored_bytes)


def _scenes_of(spending: Spending, scenes: int) -> Spent:
    share = scenes / spending.scenes if spending.scenes else 0.0
    wall_s, cpu_s = (
        sum(stage[name] for name in SCENE_STAGES)
        for stage in (spending.useful.stage_wall_s, spending.useful.stage_cpu_s)
    )
    return Spent(share * wall_s, share * cpu_s)


def label_counts(labelled: Labelled | None) -> dict[str, dict[str, Any]]:
    """Labels and positives of the whole grids and of the candidates within reach."""

    def count(candidates: str) -> dict[str, Any]:
        if labelled is None:
            return {"labels": 0, "positives": 0, "positive_share": None}
        rows = labelled.is_in(candidates)
        n, positives = int(rows.sum()), int(labelled.label[rows].sum())
        return {"labels": n, "positives": positives, "positive_share": positives / n if n else None}

    return {name: count(name) for name in ("grid", "in-range")}


def cost_per(total: Spent, counts: Mapping[str, int], prices: Prices) -> dict[str, dict[str, Any] | None]:
    """For each kind of label or scene with its number: wall and core seconds and money of one; None for 0."""
    return {
        name: {
            "count": count,
            "wall_s": total.wall_s / count,
            "core_s": total.core_s / count,
            "money": total.money(prices) / count,
        }
        if count
        else None
        for name, count in counts.items()
    }


def source_costs(
    spending: Spending, costs: Iterable[RunCost], labelled: Labelled | None, prices: Prices
) -> dict[str, Any]:
    """Cost of the runs of one label source by kind of label, in seconds and money, and its projection."""
    each = list(costs)
    total = sum((cost.total for cost in each), Spent())
    counts = label_counts(labelled)
    units = {
        "label": spending.labels,
        "label_within_reach": counts["in-range"]["labels"],
        "positive": spending.positives,
        "positive_within_reach": counts["in-range"]["positives"],
        "accepted_scene": spending.scenes,
    }
    per = cost_per(total, units, prices)
    rejected = spending.redraws.total()
    parts = {
        "committed": sum((cost.committed for cost in each), Spent()),
        "waste": sum((cost.waste for cost in each), Spent()),
        "relabelled": sum((cost.relabelled for cost in each), Spent()),
        "scenes_of_other_runs": sum((cost.scenes or Spent() for cost in each), Spent()),
        "own": sum((cost.own for cost in each), Spent()),
        "total": total,
    }
    return {
        "counts": counts,
        "spent": {
            name: {f.name: getattr(spent, f.name) for f in fields(spent)} | {"money": spent.money(prices)}
            for name, spent in parts.items()
        },
        # False: scenes were made by a run that is not among those audited, and their cost is not included.
        "includes_scenes": all(cost.scenes is not None for cost in each),
        "gpu_s": spending.useful.gpu_s,
        "cost_per": per,
        "scene_tries": {
            "accepted": spending.scenes,
            "rejected": rejected,
            "rejected_share": rejected / (rejected + spending.scenes) if spending.scenes else None,
        },
        "money_by_waste": {
            kind: _spent(account).money(prices) for kind, account in sorted(spending.waste.items())
        },
        "waste_causes": _causes(spending, prices),
        "projections": {kind: _projection(per[kind], prices) for kind in ("label", "label_within_reach")},
    }


def _causes(spending: Spending, prices: Prices) -> list[dict[str, Any]]:
    """The costliest causes of failed attempts."""
    ranked = sorted(spending.causes.items(), key=lambda item: (-item[1].core_s, item[0]))
    return [
        {
            "outcome": outcome,
            "cause": cause,
            "attempts": account.attempts,
            "core_s": account.core_s,
            "money": _spent(account).money(prices),
        }
        for (outcome, cause), account in ranked[:_MOST_CAUSES]
    ]


def _projection(per: dict[str, Any] | None, prices: Prices) -> dict[str, Any] | None:
    if per is None:
        return None
    days = {f"{clock}_days": per[f"{clock}_s"] * PAPER_LABELS / _DAY_S for clock in ("wall", "core")}
    return {"labels": PAPER_LABELS, **days, "money": per["money"] * PAPER_LABELS}


def paper_costs(prices: Prices) -> dict[str, dict[str, float]]:
    """The paper's GPU-days for as many labels by label source, and their money at the price of a GPU-hour."""
    return {
        source: {"gpu_days": days, "money": prices.cost_of(gpu_s=days * _DAY_S)}
        for source, days in PAPER_DAYS.items()
    }


def audit_report(spending: Spending, source: str, prices: Prices | None = None) -> dict[str, Any]:
    """Return the sums of one label source as plain values; times in seconds, sizes in bytes."""
    prices = prices or read_prices()
    labels, useful = spending.labels, spending.useful
    stages: dict[str, dict[str, float]] = {
        stage: {"wall_s": useful.stage_wall_s[stage], "cpu_s": useful.stage_cpu_s[stage]}
        for stage in STAGES
        if stage in useful.stage_wall_s
    }
    stages["other"] = {"wall_s": useful.unnamed_wall_s, "cpu_s": useful.unnamed_cpu_s}
    for stage in stages.values():
        stage["money"] = prices.cost_of(stage["cpu_s"])
    # Quarantined shards last: the other kinds are outcomes.
    waste = {
        kind: _account(account)
        for kind, account in sorted(
            spending.waste.items(), key=lambda item: (item[0] == QUARANTINED, item[0])
        )
    }
    per_label_s = spending.wall_s_per_label
    return {
        "label_source": source,
        "labels": labels,
        "positives": spending.positives,
        "positive_share": spending.positives / labels if labels else None,
        "scenes": spending.scenes,
        "redraws": dict(sorted(spending.redraws.items())),
        "useful": _account(useful),
        "relabelled_from": {f"{clock}_s": useful.source_s[clock] for clock in ("wall", "cpu")},
        "stages": stages,
        "waste": waste,
        "waste_share": 1 - useful.wall_s / spending.total_wall_s if spending.total_wall_s else None,
        "attempts_running": spending.running,
        "wall_s_per_label": per_label_s,
        "bytes_per_label": useful.written_bytes / labels if labels else None,
        "projection": {
            "labels": PAPER_LABELS,
            "worker_days": per_label_s * PAPER_LABELS / _DAY_S if per_label_s is not None else None,
            "paper_days": PAPER_DAYS.get(source),
            "bytes": useful.written_bytes / labels * PAPER_LABELS if labels else None,
        },
        "machines": dict(spending.machines),
    }


def _account(account: Account) -> dict[str, Any]:
    names = ("attempts", "without_account", "wall_s", "cpu_s", "core_s", "written_bytes", "peak_rss_bytes")
    return {name: getattr(account, name) for name in names}

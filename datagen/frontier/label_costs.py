"""Cost of a label of each source, from the ledgers of its runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from datagen.reports.prices import Prices
from datagen.reports.spending import account_for
from datagen.schemas.errors import InputError
from datagen.schemas.merged_runs import open_runs


@dataclass(frozen=True)
class LabelCost:
    """CPU seconds and money of one label, waste and relabelled labels included; storage in the money."""

    cpu_s: float
    money: float


def label_costs(runs: Mapping[str, Sequence[str]], prices: Prices) -> dict[str, LabelCost]:
    """The cost of a label of each source. InputError for runs whose ledger has no CPU second."""
    found: dict[str, LabelCost] = {}
    for source, places in runs.items():
        spent = account_for(run for place in places for run in open_runs(place))
        cpu_s = spent.useful.cpu_s + spent.useful.source_s["cpu"]
        cpu_s += sum(account.cpu_s for account in spent.waste.values())
        if not spent.labels or not cpu_s:
            fix = "Name a run with its ledger, not a sealed store or a copy without records"
            raise InputError(", ".join(places), "cost", "no CPU second is recorded", fix)
        money = prices.cost_of(cpu_s=cpu_s, stored_bytes=spent.useful.written_bytes)
        found[source] = LabelCost(cpu_s / spent.labels, money / spent.labels)
    return found

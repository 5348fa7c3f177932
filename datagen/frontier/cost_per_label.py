"""Cost of a label of each source, from the ledgers of its runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from datagen.reports.label_costs import costs_of_runs
from datagen.reports.prices import Prices
from datagen.reports.spending import account_for
from datagen.schemas.errors import InputError
from datagen.schemas.merged_runs import open_runs


@dataclass(frozen=True)
class LabelCost:
    """Core seconds and money of one label; waste, scenes and storage are included."""

    cpu_s: float
    money: float


def label_costs(runs: Mapping[str, Sequence[str]], prices: Prices) -> dict[str, LabelCost]:
    """The cost of a label of each source.

    InputError for runs whose records have no time, and where the scenes of --scenes-from were made by a run
    that is not among these.
    """
    named = [(source, path) for source, paths in runs.items() for path in paths]
    opened = [(source, run) for source, path in named for run in open_runs(path)]
    spendings = [account_for([run]) for _, run in opened]
    costs = costs_of_runs([run for _, run in opened], spendings)
    labels, core_s, money = (dict.fromkeys(runs, 0.0) for _ in range(3))
    for (source, run), spending, cost in zip(opened, spendings, costs, strict=True):
        if cost.scenes is None:
            problem = "has scenes of a run that is not named, so their cost is unknown"
            raise InputError(run.storage.url, "scenes_from", problem, "Name that run too")
        labels[source] += spending.labels
        core_s[source] += cost.total.core_s
        money[source] += cost.total.money(prices)
    for source, paths in runs.items():
        if not labels[source] or not core_s[source]:
            fix = "Name a run with its ledger, not a sealed store or a copy without records"
            raise InputError(", ".join(paths), "cost", "no CPU second is recorded", fix)
    return {name: LabelCost(core_s[name] / labels[name], money[name] / labels[name]) for name in runs}

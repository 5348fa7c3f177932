"""Estimates as plain values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from datagen.estimation.mixed_labels import MixedLabels
from datagen.estimation.rates import LEVEL, Interval, RateEstimate, estimate_rate
from datagen.reports.spending import account_for
from datagen.train.inputs import F64

if TYPE_CHECKING:
    from datagen.estimation.picks import Scored


def estimation_report(
    labels: MixedLabels, sets: Sequence[str], scores: Sequence[Scored], half_width: float | None
) -> dict[str, Any]:
    """Return the rates of candidate sets and of methods' picks; None where a value is undefined.

    Seconds are CPU time, with waste, of the dear runs. `further_labels` counts all candidates that are
    labelled, not only those in the population.
    """
    spending = account_for(labels.dear_runs)
    spent_s = spending.useful.cpu_s + sum(account.cpu_s for account in spending.waste.values())
    cpu_s_per_label = spent_s / spending.labels if spending.labels else 0.0
    fitted = labels.fitted()
    populations: list[tuple[str, F64]] = [(name, labels.member(name)) for name in sets]
    populations += [(f"picks of {method.name}", method.member(labels)) for method in scores]
    estimates: list[dict[str, Any]] = []
    for name, member in populations:
        found = estimate_rate(fitted.population, member)
        estimates.append(
            {"population": name, "candidates": float(member.sum())}
            | ({"rate": None} if found is None else _rate_record(found, fitted, half_width, cpu_s_per_label))
            | {"cheap_rates": _rates(labels, member)}
        )
    return {
        "cheap": list(labels.cheap_names),
        "dear": labels.dear_name,
        "cheap_runs": [run.storage.url for run in labels.cheap_runs],
        "dear_runs": [run.storage.url for run in labels.dear_runs],
        "selected": labels.is_selected,
        "level": LEVEL,
        "scenes": labels.population.n_scenes,
        "dear_labels": int(labels.population.is_dear.sum()),
        "cpu_s_per_dear_label": cpu_s_per_label,
        "half_width": half_width,
        "estimates": estimates,
    }


def _rate_record(
    found: RateEstimate, labels: MixedLabels, half_width: float | None, cpu_s_per_label: float
) -> dict[str, Any]:
    record: dict[str, Any] = {
        **_interval(found.mixed),
        "dear_alone": _interval(found.dear_alone),
        "weights": dict(zip(labels.cheap_names, found.weights, strict=True)),
        "dear_labels": found.dear_labels,
        "dear_scenes": found.dear_scenes,
        "effective_labels": found.effective_labels,
    }
    if half_width is not None:
        # Scenes cannot be labelled in part: all labels grow, not only those of the population.
        factor = found.growth(half_width)
        more = None if math.isinf(factor) else math.ceil((factor - 1) * labels.population.is_dear.sum())
        scenes = None if math.isinf(factor) else math.ceil(factor * found.dear_scenes)
        record |= {
            "further_labels": more,
            "further_cpu_s": None if more is None else more * cpu_s_per_label,
            "scenes_suffice": scenes is not None and scenes <= found.scenes,
        }
    return record


def _rates(labels: MixedLabels, member: F64) -> dict[str, float | None]:
    """The mean of each cheap column in a population."""
    total = float(member.sum())
    means = (member @ labels.population.cheap / total).tolist() if total else [None] * len(labels.cheap_names)
    return dict(zip(labels.cheap_names, means, strict=True))


def _interval(interval: Interval) -> dict[str, float]:
    fields = asdict(interval)
    del fields["variance"]
    return {**fields, "half_width": interval.half_width}

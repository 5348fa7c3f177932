"""The labels to buy next: sources compared by the accuracy that a joint learning curve predicts.

As in Learn-Optimize-Collect (Mahmood et al. 2022, arXiv 2210.01234), the curve's uncertainty is a bootstrap
of its fit, and a purchase is judged over all resamples.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from datagen.frontier.cost_per_label import LabelCost
from datagen.frontier.learning_curves import LearningCurve
from datagen.train.inputs import F64

# Gains below this count as none: a hundredth of a point of accuracy.
_NO_GAIN = 1e-4
# Splits of a budget among the sources are tried in tenths.
_PARTS = 10
_BUDGETS_CPU_H = np.geomspace(0.01, 10_000, 121)


@dataclass(frozen=True, eq=False)
class Purchase:
    """Further labels of each source, and the accuracy that the curve predicts with them."""

    labels: Mapping[str, int]
    cpu_h: float
    accuracy: float
    resamples: F64  # (B,)


@dataclass(frozen=True, eq=False)
class Advice:
    """Purchases for one budget: each source alone, and the best split.

    `wins`: share of resamples in which a source alone is the best; "nothing" where none gains a hundredth
    of a point.
    """

    now: float
    now_resamples: F64  # (B,)
    alone: Mapping[str, Purchase]
    wins: Mapping[str, float]
    split: Purchase

    @property
    def best(self) -> str:
        """The source that wins most often; ties go to the higher predicted accuracy."""
        return max(self.alone, key=lambda name: (self.wins[name], self.alone[name].accuracy))


@dataclass(frozen=True, eq=False)
class Target:
    """Core-hours that reach an accuracy in half and in nine tenths of the resamples, with their labels.

    None where 10,000 core-hours are not enough.
    """

    accuracy: float
    reached_by_half: Purchase | None
    reached_by_most: Purchase | None


def advise(
    curve: LearningCurve, sources: Sequence[str], now: F64, costs: Mapping[str, LabelCost], cpu_h: float
) -> Advice:
    """Compare spending `cpu_h` core-hours of labels on each source, in addition to labels `now` (K,)."""
    before, before_all = _with_or_without_cheap(curve, now)
    alone = {
        name: _purchase(curve, sources, now, costs, cpu_h, np.eye(len(sources))[k])
        for k, name in enumerate(sources)
    }
    gains = np.stack([purchase.resamples - before_all for purchase in alone.values()])  # (K, B)
    winner = np.where(gains.max(axis=0) > _NO_GAIN, gains.argmax(axis=0), len(sources))
    wins = {name: float(np.mean(winner == k)) for k, name in enumerate([*sources, "nothing"])}
    splits = [_purchase(curve, sources, now, costs, cpu_h, split) for split in _splits(len(sources))]
    best = max(splits, key=lambda purchase: float(purchase.resamples.mean()))
    return Advice(float(before), before_all, alone, wins, best)


def cheapest(
    curve: LearningCurve, sources: Sequence[str], now: F64, costs: Mapping[str, LabelCost], accuracy: float
) -> Target:
    """The smallest budgets, and their best splits, that reach an accuracy."""
    found: list[Purchase | None] = [None, None]
    for cpu_h in _BUDGETS_CPU_H:
        tried = [_purchase(curve, sources, now, costs, float(cpu_h), s) for s in _splits(len(sources))]
        shares = [float(np.mean(purchase.resamples >= accuracy)) for purchase in tried]
        for k, needed in enumerate((0.5, 0.9)):
            if found[k] is None and max(shares) >= needed:
                found[k] = tried[int(np.argmax(shares))]
        if found[1] is not None:
            break
    return Target(accuracy, *found)


def _splits(n: int) -> list[F64]:
    """All splits (n,) of a whole into tenths."""
    rest = [np.array(parts) for parts in np.ndindex(*[_PARTS + 1] * n) if sum(parts) == _PARTS]
    return [parts / _PARTS for parts in rest]


def _purchase(
    curve: LearningCurve,
    sources: Sequence[str],
    now: F64,
    costs: Mapping[str, LabelCost],
    cpu_h: float,
    split: F64,
) -> Purchase:
    more = np.array(
        [share * cpu_h * 3600 / costs[name].cpu_s for name, share in zip(sources, split, strict=True)]
    )
    accuracy, resamples = _with_or_without_cheap(curve, now + more)
    bought = {name: round(n) for name, n in zip(sources, more.tolist(), strict=True) if n >= 1}
    return Purchase(bought, cpu_h, float(accuracy), resamples)


def _with_or_without_cheap(curve: LearningCurve, labels: F64) -> tuple[float, F64]:
    """Predicted accuracy, and (B,) of the resamples; cheap labels that harm are left out."""
    accuracy, resamples = curve.accuracy(labels)
    if not curve.form.cheap:
        return float(accuracy), resamples
    without, resamples_without = curve.accuracy(np.concatenate([[0.0], labels[1:]]))
    return float(max(accuracy, without)), np.maximum(resamples, resamples_without)

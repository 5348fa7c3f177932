"""The buyer's advice in a sentence."""

from __future__ import annotations

import numpy as np

from datagen.frontier.buyer import Advice, Purchase, Target
from datagen.frontier.learning_curves import LearningCurve
from datagen.train.evaluation.bootstrap import Estimate


def advice_text(advice: Advice, cpu_h: float) -> str:
    """The best use of the next core-hours and its certainty, as a sentence."""
    best = advice.best
    bought = advice.alone[best]
    gained = Estimate(bought.accuracy - advice.now, bought.resamples - advice.now_resamples)
    low, high = gained.interval()
    rest = [f"{name} in {share:.0%}" for name, share in advice.wins.items() if name != best and share > 0]
    others = f" ({', '.join(rest)})" if rest else ""
    hours = "core-hour" if cpu_h == 1 else f"{cpu_h:g} core-hours"
    if advice.wins["nothing"] > advice.wins[best]:
        return (
            f"The next {hours} of labels gain nothing that can be measured: no source gains a hundredth of a "
            f"point in {advice.wins['nothing']:.0%} of the resamples."
        )
    return (
        f"Spend the next {hours} on {best} labels: {bought.labels.get(best, 0):,} more are expected to raise "
        f"balanced accuracy within reach from {advice.now:.1%} by {100 * gained.value:.2f} points "
        f"[{100 * low:.2f}, {100 * high:.2f}]; {best} is the best choice in {advice.wins[best]:.0%} of "
        f"{len(bought.resamples):,} resamples{others}."
    )


def target_text(target: Target, curve: LearningCurve) -> str:
    """The labels that reach the target accuracy, as a sentence."""
    if target.reached_by_half is None:
        most = float(np.median(1 - curve.resamples[:, 0]))
        return (
            f"{target.accuracy:.1%} is not reached in half of the resamples with 10,000 core-hours; "
            f"the median of the curve's limits is {most:.1%}."
        )
    text = f"{target.accuracy:.1%} is reached in half of the resamples with {_bought(target.reached_by_half)}"
    if target.reached_by_most is None:
        return f"{text}, and in nine tenths not with 10,000 core-hours."
    return f"{text}, and in nine tenths with {_bought(target.reached_by_most)}."


def _bought(purchase: Purchase) -> str:
    labels = " and ".join(f"{n:,} {name} labels" for name, n in purchase.labels.items())
    return f"{purchase.cpu_h:.2g} more core-hours ({labels or 'no further label'})"

"""The budget of a job: whether one more shard may begin.

The answer depends only on the clock, the spending and the costs seen so far. A shard begins only where it
is likely (90 %) to end within the budget, together with those in flight. No shard is ended for a budget.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from datagen.cluster.run_forecast import RunForecast
from datagen.cluster.task import AttemptReport

_SURE = 0.9


@dataclass(frozen=True)
class Budget:
    """A limit of wall seconds since the command began, or of spending: CPU seconds or money.

    Spending is the sum over all attempts, also failed ones, of CPU seconds and written bytes at their prices.
    """

    text: str  # as the user wrote it
    wall_s: float | None = None
    spending: float | None = None
    per_cpu_s: float = 1.0
    per_byte: float = 0.0


def ends_in_time(
    limit_s: float, now_s: float, began_s: Sequence[float | None], slots: int, shard_s: float
) -> bool:
    """Whether one more shard ends by `limit_s`, if every shard takes `shard_s`.

    `began_s`: when each attempt in flight began; None where it waits for one of the `slots` workers.
    """
    ends_s = [max(now_s, began + shard_s) for began in began_s if began is not None]
    free_s = ends_s + [now_s] * max(0, slots - len(ends_s))
    heapq.heapify(free_s)
    for _ in range(began_s.count(None)):
        heapq.heapreplace(free_s, free_s[0] + shard_s)
    return free_s[0] + shard_s <= limit_s


@dataclass
class BudgetGuard:
    """Decides before each attempt whether it fits the budget of the job, which may span several runs."""

    budget: Budget
    began_s: float  # when the command began, by the driver's clock
    spent: float = 0.0
    forecast: RunForecast | None = None  # of the run that is made now
    _bounds: dict[tuple[int, int, int], float] = field(default_factory=dict[tuple[int, int, int], float])

    def use(self, forecast: RunForecast) -> None:
        """Switch to the shards of another run."""
        self.forecast = forecast
        self._bounds.clear()

    def count(self, report: AttemptReport) -> None:
        """Add the cost of an ended attempt."""
        if report.cost is None:
            return
        stored = report.cost.written_bytes if report.outcome == "committed" else 0
        self.spent += self.budget.per_cpu_s * report.cost.cpu_s + self.budget.per_byte * stored

    def allows(self, now_s: float, began_s: Sequence[float | None], slots: int) -> bool:
        """Whether one more attempt may begin, next to those in flight (see `ends_in_time`).

        Until the cost of a shard is known, each worker gets one.
        """
        budget, forecast = self.budget, self.forecast
        elapsed_s = now_s - self.began_s
        if forecast is None or not forecast.seen:
            is_over = elapsed_s >= (budget.wall_s or np.inf) or self.spent >= (budget.spending or np.inf)
            return len(began_s) < slots and not is_over
        if budget.wall_s is not None:
            limit_s = self.began_s + budget.wall_s
            return ends_in_time(limit_s, now_s, began_s, slots, self._bound(0, slots))
        return self.spent + self._bound(len(began_s) + 1, slots) <= (budget.spending or 0.0)

    def _bound(self, shards: int, slots: int) -> float:
        """Upper bound of the spending of these shards; with 0, of the wall seconds of one."""
        forecast = self.forecast
        assert forecast is not None
        key = (forecast.seen, shards, slots)
        if key not in self._bounds:
            if len(self._bounds) > 1000:
                self._bounds.clear()
            prices = self.budget.per_cpu_s, self.budget.per_byte
            self._bounds[key] = (
                float(np.quantile(forecast.spending(shards, slots, *prices), _SURE))
                if shards
                else forecast.longest_shard_s(slots)
            )
        return self._bounds[key]

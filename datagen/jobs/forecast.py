"""The forecast of a job, as plain values and as lines of text."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from datagen.cluster.shard_costs import Interval
from datagen.console.printing import counted, print_rows, seconds, size
from datagen.reports.prices import Prices


@dataclass(frozen=True)
class Forecast:
    """The shards and the cost of a job. Every interval holds the truth in about 80 % of jobs.

    Shards, scenes and labels are exact: shards are whole, and a scene that is rejected is sampled again.
    """

    shards: int
    scenes: int
    labels: int
    workers: int
    wall_s: Interval  # from the command to its last shard, if the machine is as busy as it was
    cpu_s: Interval
    stored_bytes: Interval  # of the shards' files
    money: Interval  # of CPU time and storage, in the currency of `prices`
    prices: Prices
    evidence: str  # the shards that it rests on
    budget: str = ""
    within_budget: float | None = None  # probability that all shards fit the budget

    def record(self) -> dict[str, Any]:
        """Plain values for JSON."""
        intervals = {
            name: getattr(self, name).record() for name in ("wall_s", "cpu_s", "stored_bytes", "money")
        }
        return {
            "shards": self.shards,
            "scenes": self.scenes,
            "labels": self.labels,
            "workers": self.workers,
            **intervals,
            "interval": 0.8,
            "prices": self.prices.record(),
            "evidence": self.evidence,
            "budget": self.budget or None,
            "within_budget": self.within_budget,
        }


def print_forecast(path: str, forecast: Forecast) -> None:
    """Print a forecast as a table."""
    kept = forecast.prices.months_kept
    months = "1 month" if kept == 1 else f"{kept:g} months"
    rows = [
        ("shards", f"{forecast.shards:,} ({counted(forecast.scenes, 'scene')})", ""),
        ("labels", f"{forecast.labels:,}", ""),
        ("time", *_shown(forecast.wall_s, seconds)),
        ("CPU time", *_shown(forecast.cpu_s, seconds)),
        ("stored", *_shown(forecast.stored_bytes, size)),
        ("money", *_shown(forecast.money, forecast.prices.format)),
    ]
    if forecast.within_budget is not None:
        rows.append(
            ("budget", f"{forecast.budget}: enough with {100 * forecast.within_budget:.0f}% probability", "")
        )
    print_rows(f"dry run: {path}", rows, ("", "median", "80% interval"))
    print_rows(
        "about",
        [
            ("from", forecast.evidence),
            ("workers", f"{forecast.workers}, on a machine as busy as it was"),
            ("money", f"of CPU time and {months} of storage; --prices FILE has other prices"),
            ("without", "retries of failed shards"),
        ],
    )


def _shown(interval: Interval, text: Callable[[float], str]) -> tuple[str, str]:
    return text(interval.middle), f"{text(interval.low)} to {text(interval.high)}"

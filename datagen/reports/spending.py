"""What the ledger and the commits of runs say together: labels, cost and waste."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from math import fsum

from datagen.schemas.run import Run
from datagen.schemas.run_records import Cost
from datagen.schemas.summaries import Summaries


@dataclass
class Account:
    """Sums over some attempts; seconds, bytes."""

    attempts: int = 0
    unaccounted: int = 0  # attempts that left no account of their cost
    wall_s: float = 0.0
    cpu_s: float = 0.0
    stage_wall_s: Counter[str] = field(default_factory=Counter)
    stage_cpu_s: Counter[str] = field(default_factory=Counter)
    source_s: Counter[str] = field(default_factory=Counter)  # by wall and cpu: what was taken over had cost
    written_bytes: int = 0
    peak_rss_bytes: int = 0

    def add(self, cost: Cost | None) -> None:
        """Add one attempt."""
        self.attempts += 1
        if cost is None:
            self.unaccounted += 1
            return
        self.wall_s += cost.wall_s
        self.cpu_s += cost.cpu_s
        self.stage_wall_s.update(cost.stage_wall_s)
        self.stage_cpu_s.update(cost.stage_cpu_s)
        self.source_s.update(cost.source_s)
        self.written_bytes += cost.written_bytes
        self.peak_rss_bytes = max(self.peak_rss_bytes, cost.peak_rss_bytes)

    @property
    def unnamed_wall_s(self) -> float:
        """Wall seconds that no stage claimed."""
        return max(0.0, self.wall_s - fsum(self.stage_wall_s.values()))


@dataclass
class Spending:
    """All that was paid for a set of runs, split into what became data and what did not."""

    labels: int = 0
    positives: int = 0
    scenes: int = 0
    redraws: Counter[str] = field(default_factory=Counter)
    useful: Account = field(default_factory=Account)
    waste: dict[str, Account] = field(default_factory=dict)  # by outcome
    running: int = 0  # attempts that began and have not ended
    machines: Counter[str] = field(default_factory=Counter)  # attempts by processor

    @property
    def wall_s_per_label(self) -> float | None:
        """Seconds of workers for a label, waste and the labels it was made from included."""
        return (self.total_wall_s + self.useful.source_s["wall"]) / self.labels if self.labels else None

    @property
    def total_wall_s(self) -> float:
        """Seconds of workers that these runs themselves took."""
        return self.useful.wall_s + sum(a.wall_s for a in self.waste.values())


def account_for(runs: Iterable[Run]) -> Spending:
    """Read commits and ledgers. A committed attempt is counted from its commit, once.

    The ledger's other entries are waste by their outcome: ledger = commits + waste. An attempt
    whose commit exists and whose ledger entry does not (the driver died between the two) is useful
    all the same.
    """
    spending = Spending()
    for run in runs:
        summaries, committed = Summaries(run), set[str]()
        for commit in summaries.commits():
            committed.add(commit.attempt)
            spending.labels += commit.samples
            spending.positives += commit.positives
            spending.scenes += commit.scenes
            spending.redraws.update(commit.redraws)
            spending.useful.add(commit.cost)
            spending.machines[f"{commit.host.cpu}, {commit.host.cores} cores"] += 1
        for entry in summaries.ends():
            if entry.attempt not in committed:
                spending.waste.setdefault(entry.outcome, Account()).add(entry.cost)
        spending.running += sum(start.attempt not in committed for start in summaries.unfinished())
    return spending

"""Labels, cost and waste of runs, from their ledgers and commits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from math import fsum

from datagen.schemas.run import Run
from datagen.schemas.run_records import Cost

QUARANTINED = "quarantined"


@dataclass
class Account:
    """Sums over attempts; seconds and bytes."""

    attempts: int = 0
    without_account: int = 0  # attempts without a recorded cost
    wall_s: float = 0.0
    cpu_s: float = 0.0
    unmeasured_cpu_s: float = 0.0  # wall seconds of killed attempts, whose CPU time was lost with the process
    gpu_s: float | None = None  # None where no record has GPU seconds
    stage_wall_s: Counter[str] = field(default_factory=Counter)
    stage_cpu_s: Counter[str] = field(default_factory=Counter)
    source_s: Counter[str] = field(default_factory=Counter)  # "wall" and "cpu": cost of relabelled files
    written_bytes: int = 0
    peak_rss_bytes: int = 0

    def add(self, cost: Cost | None) -> None:
        """Add one attempt."""
        self.attempts += 1
        if cost is None:
            self.without_account += 1
            return
        self.wall_s += cost.wall_s
        self.cpu_s += cost.cpu_s
        if not cost.cpu_s:
            self.unmeasured_cpu_s += cost.wall_s
        if cost.stage_gpu_s:
            self.gpu_s = (self.gpu_s or 0.0) + fsum(cost.stage_gpu_s.values())
        self.stage_wall_s.update(cost.stage_wall_s)
        self.stage_cpu_s.update(cost.stage_cpu_s)
        self.source_s.update(cost.source_s)
        self.written_bytes += cost.written_bytes
        self.peak_rss_bytes = max(self.peak_rss_bytes, cost.peak_rss_bytes)

    @property
    def unnamed_wall_s(self) -> float:
        """Wall seconds that no stage claimed."""
        return max(0.0, self.wall_s - fsum(self.stage_wall_s.values()))

    @property
    def unnamed_cpu_s(self) -> float:
        """CPU seconds that no stage claimed."""
        return max(0.0, self.cpu_s - fsum(self.stage_cpu_s.values()))

    @property
    def core_s(self) -> float:
        """Seconds of a core to pay for: CPU seconds, and wall seconds of killed attempts."""
        return self.cpu_s + self.unmeasured_cpu_s


@dataclass
class Spending:
    """The cost of a set of runs, split into committed attempts and waste."""

    labels: int = 0
    positives: int = 0
    scenes: int = 0
    redraws: Counter[str] = field(default_factory=Counter)
    useful: Account = field(default_factory=Account)
    # By outcome; attempts at shards that are quarantined now are under QUARANTINED, whatever their outcome.
    waste: dict[str, Account] = field(default_factory=dict)
    causes: dict[tuple[str, str], Account] = field(default_factory=dict)  # waste by (outcome, cause)
    running: int = 0  # attempts that began and have not ended
    machines: Counter[str] = field(default_factory=Counter)  # attempts by processor

    @property
    def wall_s_per_label(self) -> float | None:
        """Worker seconds per label, waste and relabelled files included."""
        return (self.total_wall_s + self.useful.source_s["wall"]) / self.labels if self.labels else None

    @property
    def total_wall_s(self) -> float:
        """Worker seconds of these runs themselves."""
        return self.useful.wall_s + sum(a.wall_s for a in self.waste.values())


def account_for(runs: Iterable[Run]) -> Spending:
    """Add up commits and ledgers. A committed attempt is counted once, from its commit.

    The other entries of the ledger are waste by their outcome: ledger = commits + waste. An attempt with a
    commit but without a ledger entry (the driver died between the two) counts as useful.
    """
    spending = Spending()
    for run in runs:
        # Before the commits: every attempt that the ledger calls committed then has its commit.
        ends, unfinished = list(run.ledger.ends()), run.ledger.unfinished()
        committed, quarantined = set[str](), run.quarantined()
        for commit in run.commits():
            committed.add(commit.attempt)
            spending.labels += commit.samples
            spending.positives += commit.positives
            spending.scenes += commit.scenes
            spending.redraws.update(commit.redraws)
            spending.useful.add(commit.cost)
            spending.machines[f"{commit.host.cpu}, {commit.host.cores} cores"] += 1
        for entry in ends:
            if entry.attempt not in committed:
                kind = QUARANTINED if entry.shard in quarantined else entry.outcome
                spending.waste.setdefault(kind, Account()).add(entry.cost)
                spending.causes.setdefault((entry.outcome, entry.cause), Account()).add(entry.cost)
        spending.running += sum(start.attempt not in committed for start in unfinished)
    return spending

"""Labels, cost and waste of runs, from their ledgers and commits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from math import fsum

from datagen.schemas.record_files import is_guess
from datagen.schemas.run import MOST_SAMPLES, Run
from datagen.schemas.run_records import Cost

QUARANTINED = "quarantined"


@dataclass
class Account:
    """Sums over attempts; seconds and bytes."""

    attempts: int = 0
    unknown: int = 0  # attempts without a recorded cost
    wall_s: float = 0.0
    core_s: float = 0.0  # CPU seconds; wall seconds of killed attempts, whose CPU time was lost with them
    stage_s: Counter[str] = field(default_factory=Counter)  # CPU seconds by stage
    relabelled_s: float = 0.0  # CPU seconds that another run spent on relabelled files
    written_bytes: int = 0
    peak_rss_bytes: int = 0

    def add(self, cost: Cost | None) -> None:
        """Add one attempt."""
        self.attempts += 1
        if cost is None:
            self.unknown += 1
            return
        self.wall_s += cost.wall_s
        self.core_s += cost.cpu_s or cost.wall_s
        self.stage_s.update(cost.stage_cpu_s)
        self.relabelled_s += cost.source_s.get("cpu", 0.0)
        self.written_bytes += cost.written_bytes
        self.peak_rss_bytes = max(self.peak_rss_bytes, cost.peak_rss_bytes)


@dataclass
class Spending:
    """The cost of a set of runs: each attempt of the ledgers is either committed or waste."""

    labels: int = 0
    scenes: int = 0
    rejected: Counter[str] = field(default_factory=Counter)  # tries of scenes, by cause
    useful: Account = field(default_factory=Account)
    # By outcome; attempts at shards that are quarantined now are under QUARANTINED, whatever their outcome.
    waste: dict[str, Account] = field(default_factory=dict)
    causes: dict[str, Account] = field(default_factory=dict)  # failed attempts by their cause
    machines: Counter[str] = field(default_factory=Counter)  # attempts by processor
    contradictions: int = 0  # records of the ledger that do not fit the commits

    @property
    def wasted(self) -> Account:
        """The sum of the waste."""
        return Account(
            attempts=sum(each.attempts for each in self.waste.values()),
            unknown=sum(each.unknown for each in self.waste.values()),
            wall_s=fsum(each.wall_s for each in self.waste.values()),
            core_s=fsum(each.core_s for each in self.waste.values()),
        )


def account_for(runs: Iterable[Run]) -> Spending:
    """Add up commits and ledgers: each attempt has a commit, or an end in the ledger, which is waste."""
    spending = Spending()
    for run in runs:
        committed, quarantined = set[str](), run.quarantined()
        for commit in run.commits():
            committed.add(commit.attempt)
            spending.rejected.update(commit.redraws)
            spending.machines[f"{commit.host.cpu}, {commit.host.cores} cores"] += 1
            rows = run.rows_of(commit.shard, MOST_SAMPLES)
            if not rows.scenes:  # another part of these merged runs has its scenes
                spending.waste.setdefault("superseded", Account()).add(commit.cost)
                continue
            spending.labels += rows.samples
            spending.scenes += rows.scenes
            spending.useful.add(commit.cost)
        for end in run.ledger.ends():
            if end.attempt in committed:
                spending.contradictions += not is_guess(end)
            else:
                kind = QUARANTINED if end.shard in quarantined else end.outcome
                spending.waste.setdefault(kind, Account()).add(end.cost)
                if end.cause:
                    spending.causes.setdefault(end.cause, Account()).add(end.cost)
    return spending

"""Running sums of a job and its summary, in constant memory."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, fields
from typing import Literal, get_args

from datagen.cluster.task import AttemptReport
from datagen.schemas.run_records import Outcome

End = Literal["complete", "budget", "failed", "interrupted", "aborted"]  # each worse than the one before
_NAMED = 20  # quarantined shards that the summary lists by number


@dataclass
class JobTotals:
    """Counts since this driver began. Seconds are sums over attempts."""

    shards: int  # of this job, without those done before
    committed: int = 0
    superseded: int = 0  # shards that another driver or an earlier attempt had committed
    elsewhere: int = 0  # shards that another driver had committed before an attempt began here
    quarantined: int = 0
    quarantined_shards: list[int] = field(default_factory=list)  # the first few
    retries: int = 0
    in_flight: int = 0
    outcomes: Counter[Outcome] = field(default_factory=Counter)  # attempts by how they ended
    labels: int = 0
    positives: int = 0
    useful_wall_s: float = 0.0
    useful_cpu_s: float = 0.0
    wasted_wall_s: float = 0.0
    wasted_cpu_s: float = 0.0

    @property
    def finished(self) -> int:
        """Shards that need no further attempt."""
        return self.committed + self.superseded + self.elsewhere + self.quarantined

    def count(self, report: AttemptReport) -> None:
        self.outcomes[report.outcome] += 1
        wall_s, cpu_s = (report.cost.wall_s, report.cost.cpu_s) if report.cost else (0.0, 0.0)
        if report.outcome == "committed":
            self.committed += 1
            self.labels += report.labels
            self.positives += report.positives
            self.useful_wall_s += wall_s
            self.useful_cpu_s += cpu_s
        else:
            self.superseded += report.outcome == "superseded"
            self.wasted_wall_s += wall_s
            self.wasted_cpu_s += cpu_s

    def count_quarantined(self, shard: int) -> None:
        self.quarantined += 1
        if len(self.quarantined_shards) < _NAMED:
            self.quarantined_shards.append(shard)

    def plus(self, other: JobTotals) -> JobTotals:
        sums = {f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(JobTotals)}
        sums["quarantined_shards"] = sums["quarantined_shards"][:_NAMED]
        return JobTotals(**sums)


@dataclass(frozen=True)
class JobSummary:
    """How a job ended.

    complete: every shard is committed or, within the allowed share, quarantined. budget: no further shard
    fits the budget. interrupted: by a stop request. failed: too many shards are quarantined. aborted: `cause`
    names an error that no retry can fix, and its fix.
    """

    end: End
    cause: str
    totals: JobTotals
    elapsed_s: float
    start_s: float = 0.0  # before the driver began

    @property
    def remaining(self) -> int:
        return self.totals.shards - self.totals.finished

    @property
    def exit_code(self) -> int:
        """Exit code of the command line: 0 complete, 1 failed, 2 aborted, 3 budget spent, 130 interrupted."""
        return {"complete": 0, "failed": 1, "aborted": 2, "budget": 3, "interrupted": 130}[self.end]

    def plus(self, later: JobSummary) -> JobSummary:
        """The sum of both, for one job over several runs, with the worse end and its first cause."""
        worst = max(self, later, key=lambda summary: get_args(End).index(summary.end))
        totals = self.totals.plus(later.totals)
        return JobSummary(worst.end, worst.cause, totals, self.elapsed_s + later.elapsed_s)


def empty_summary() -> JobSummary:
    """Summary of a job without work."""
    return JobSummary("complete", "", JobTotals(0), 0.0)

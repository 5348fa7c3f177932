"""Progress of a job: a driver's events shown as progress of its shards."""

from __future__ import annotations

from datagen.cluster.job_totals import JobTotals
from datagen.cluster.task import AttemptReport
from datagen.schemas.progress import Pace, Progress, clock_text, whole


class JobProgress:
    """Events that show shards done, rate, time left, retries, quarantined shards and cost so far.

    `done_before` counts the shards of earlier jobs.
    """

    def __init__(self, shown: Progress, labels_per_shard: int, done_before: int = 0) -> None:
        self._shown, self._pace, self._labels_per_shard = shown, Pace(shown.clock), labels_per_shard
        self._done_before, self._note = done_before, ""

    def ended(self, report: AttemptReport, action: str) -> None:
        if action in ("retry", "quarantine", "abort"):
            values = {name: getattr(report, name) for name in ("shard", "attempt", "cause")}
            text = f"shard {report.shard} {report.outcome}: {report.cause} ({action})"
            style = "yellow" if action == "retry" else "red"
            self._shown.say("attempt_" + report.outcome, {**values, "action": action}, text, style)

    def tick(self, totals: JobTotals) -> None:
        self._pace.see(totals.labels)
        done, of = self._done_before + totals.finished, self._done_before + totals.shards
        self._shown.update("shards", done, of, lambda: self._figures(totals))

    def stopping(self, reason: str) -> None:
        self._note = "  stopping"
        text = f"{reason}: waiting for running attempts; Ctrl-C again stops at once"
        self._shown.say("stopping", {"reason": reason}, text, "yellow")

    def _figures(self, totals: JobTotals) -> tuple[str, dict[str, object]]:
        rate, left_s = self._pace.per_s(), left_of(totals, self._pace, self._labels_per_shard)
        cpu_s = totals.useful_cpu_s + totals.wasted_cpu_s
        # Rare figures are omitted when 0, to fit 80 columns.
        given_up = f"  {totals.quarantined} quarantined" if totals.quarantined else ""
        text = (
            f"{rate:,.0f} labels/s  {clock_text(left_s)} left  "
            f"{totals.retries} retries{given_up}  {cpu_s / 3600:.2f} core-h{self._note}"
        )
        return text, {
            "shards_done": self._done_before + totals.finished,
            "shards": self._done_before + totals.shards,
            "labels": totals.labels,
            "labels_per_s": round(rate, 1),
            "left_s": whole(left_s),
            "in_flight": totals.in_flight,
            "retries": totals.retries,
            "quarantined": totals.quarantined,
            "cpu_s": round(cpu_s, 1),
            "wasted_wall_s": round(totals.wasted_wall_s, 1),
        }


def left_of(totals: JobTotals, pace: Pace, labels_per_shard: int) -> float | None:
    """Seconds until the last shard at the current rate; None while unknown."""
    return pace.left_s((totals.shards - totals.finished) * labels_per_shard)

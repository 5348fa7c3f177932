"""What people and programs see of a running job."""

from __future__ import annotations

import io
import json

from rich.console import Console

from datagen.cluster.job_progress import JobProgress, TimeLeft
from datagen.cluster.job_totals import JobTotals
from datagen.cluster.run_forecast import RunForecast
from datagen.cluster.task import AttemptReport
from datagen.display.progress import Progress
from datagen.schemas.run_records import Cost
from tests.cluster.simulated import FakeClock

CRASH = AttemptReport("a", 5, "crashed", cause="Fatal Python error: Segmentation fault")


def thirty_seconds(as_json: bool) -> list[str]:
    clock, out = FakeClock(), io.StringIO()
    shown = Progress(as_json, clock, Console(file=out))
    events, totals = JobProgress(shown, 60, done_before=50), JobTotals(100)
    for second in range(1, 31):
        clock.now_s = second
        totals.committed, totals.labels = second, 60 * second
        events.tick(totals)
    events.ended(CRASH, "retry")
    events.ended(AttemptReport("b", 6, "committed"), "done")
    events.stopping("asked to stop")
    events.tick(totals)
    shown.close()
    return out.getvalue().splitlines()


def test_json_lines_come_at_intervals_and_for_each_trouble() -> None:
    said = [json.loads(line) for line in thirty_seconds(as_json=True)]
    assert [s["event"] for s in said] == ["progress"] * 3 + ["attempt_crashed", "stopping", "progress"]
    assert said[2]["shards_done"] == 80 and said[2]["shards"] == 150
    assert said[2]["labels_per_s"] == 60.0 and said[2]["left_s"] == 70
    assert said[3]["shard"] == 5 and said[3]["action"] == "retry"


def test_lines_of_text_say_the_same() -> None:
    assert thirty_seconds(as_json=False)[2:] == [
        "shards 80/150  60 labels/s  0:01:10 left  0 retries  0.00 core-h",
        "shard 5 crashed: Fatal Python error: Segmentation fault (retry)",
        "asked to stop: waiting for running attempts; Ctrl-C again stops at once",
        "shards 80/150  60 labels/s  0:01:10 left  0 retries  0.00 core-h  stopping",
    ]


def test_the_bar_shows_rate_time_left_retries_and_cost() -> None:
    out, clock = io.StringIO(), FakeClock()
    shown = Progress(
        clock=clock, console=Console(file=out, force_terminal=True, width=160, color_system=None)
    )
    bar = JobProgress(shown, 60)
    totals = JobTotals(100, committed=40, labels=2400, retries=3, quarantined=1, useful_cpu_s=7200)
    clock.now_s = 40.0
    bar.tick(totals)
    bar.ended(CRASH, "retry")
    bar.stopping("asked to stop")
    shown.close()
    drawn = out.getvalue()
    for text in (
        "41/100", "60 labels/s", "0:00:59 left", "3 retries", "1 quarantined", "2.00 core-h",
        "shard 5 crashed: Fatal Python error", "Ctrl-C again",
    ):  # fmt: skip
        assert text in drawn


def test_a_usual_terminal_shows_all_figures() -> None:
    out, clock = io.StringIO(), FakeClock()
    shown = Progress(clock=clock, console=Console(file=out, force_terminal=True, width=80, color_system=None))
    bar = JobProgress(shown, 60)
    clock.now_s = 40.0
    bar.tick(JobTotals(3000, committed=1400, labels=84_000, retries=3, useful_cpu_s=7200))
    shown.close()
    last = [line for line in out.getvalue().splitlines() if "1400/3000" in line][-1]
    assert "2,100 labels/s  0:00:46 left  3 retries  2.00 core-h" in last
    assert "\u2026" not in last


def test_the_time_left_is_an_interval_also_after_the_executor_is_closed() -> None:
    """The last figures are shown when the job has ended: then Ray does not answer any more."""
    clock, out, is_open = FakeClock(), io.StringIO(), True

    def workers() -> int:
        assert is_open
        return 2

    shown, forecast = Progress(True, clock, Console(file=out)), RunForecast(32)
    events, totals = JobProgress(shown, 60, left=TimeLeft(forecast, workers)), JobTotals(100)
    for second in range(1, 15):
        clock.now_s = second
        totals.committed, totals.labels = second, 60 * second
        forecast.add(Cost(wall_s=2.0, cpu_s=2.0), None)
        events.tick(totals)
    is_open = False
    shown.close()
    said = [json.loads(line) for line in out.getvalue().splitlines()]
    low_s, high_s = said[-1]["left_80_s"]
    assert said[-1]["shards_done"] == 14 and 60 < low_s < 86 < high_s < 110

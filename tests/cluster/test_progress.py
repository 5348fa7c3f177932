"""What people and programs see of a running job."""

from __future__ import annotations

import io
import json

from rich.console import Console

from cluster.progress import JsonLines, Pace, TerminalBar, clock_text
from cluster.tally import Tally
from cluster.task import AttemptReport
from tests.cluster.simulated import FakeClock

CRASH = AttemptReport("a", 5, "crashed", cause="Fatal Python error: Segmentation fault")


def test_json_lines_come_at_intervals_and_for_each_trouble() -> None:
    clock, out = FakeClock(), io.StringIO()
    lines = JsonLines(60, shards=100, done_before=50, every_s=10, out=out, clock=clock)
    tally = Tally(100)
    for second in range(1, 31):
        clock.now_s = second
        tally.committed, tally.labels = second, 60 * second
        lines.tick(tally)
    lines.ended(CRASH, "retry")
    lines.ended(AttemptReport("b", 6, "committed"), "done")
    lines.stopping("asked to stop")
    lines.close()
    said = [json.loads(line) for line in out.getvalue().splitlines()]
    assert [s["event"] for s in said] == ["progress"] * 3 + ["attempt_crashed", "stopping", "progress"]
    assert said[2]["shards_done"] == 80 and said[2]["shards"] == 150
    assert said[2]["labels_per_s"] == 60.0 and said[2]["left_s"] == 70
    assert said[3]["shard"] == 5 and said[3]["action"] == "retry"


def test_the_rate_is_that_of_the_last_minute() -> None:
    clock, tally = FakeClock(), Tally(1000)
    pace = Pace(10, clock)
    assert pace.labels_per_s(tally) == 0 and pace.left_s(tally) is None
    for second in range(1, 301):
        clock.now_s = second
        tally.labels += 1 if second <= 200 else 5
        pace.see(tally)
    assert pace.labels_per_s(tally) == 5.0


def test_the_bar_shows_rate_time_left_retries_and_cost() -> None:
    out, clock = io.StringIO(), FakeClock()
    console = Console(file=out, force_terminal=True, width=160, color_system=None)
    bar = TerminalBar(60, shards=100, console=console, clock=clock)
    tally = Tally(100, committed=40, labels=2400, retries=3, quarantined=1, useful_cpu_s=7200)
    clock.now_s = 40.0
    bar.tick(tally)
    bar.ended(CRASH, "retry")
    bar.stopping("asked to stop")
    bar.close()
    shown = out.getvalue()
    for text in (
        "41/100", "60 labels/s", "0:00:59 left", "3 retries", "1 quarantined", "2.00 core-h",
        "shard 5 crashed: Fatal Python error", "Ctrl-C again",
    ):  # fmt: skip
        assert text in shown


def test_a_usual_terminal_shows_all_figures() -> None:
    out, clock = io.StringIO(), FakeClock()
    console = Console(file=out, force_terminal=True, width=80, color_system=None)
    bar = TerminalBar(60, shards=3000, console=console, clock=clock)
    clock.now_s = 40.0
    bar.tick(Tally(3000, committed=1400, labels=84_000, retries=3, useful_cpu_s=7200))
    bar.close()
    last = [line for line in out.getvalue().splitlines() if "1400/3000" in line][-1]
    assert "2,100 labels/s  0:00:46 left  3 retries  2.00 core-h" in last
    assert "\u2026" not in last


def test_clock_text() -> None:
    assert [clock_text(s) for s in (None, 0, 59.6, 3600, 360_000)] == [
        "-:--:--", "0:00:00", "0:01:00", "1:00:00", "100:00:00",
    ]  # fmt: skip

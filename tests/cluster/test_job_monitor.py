"""A job's display, its published state, and requests to stop it, against a simulated cluster."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from datagen.cluster.attempt_guard import Running
from datagen.cluster.driver import drive
from datagen.cluster.job_monitor import JobMonitor, JobProgress, JobRecorder
from datagen.cluster.protocol import AttemptReport, JobSummary, JobTotals, StopRequest
from datagen.cluster.shard_policy import RetryPolicy
from datagen.display.progress import Progress
from datagen.schemas.jobs import Jobs, JobState, Stop
from datagen.schemas.storage import open_storage
from tests.cluster.simulated import FakeClock, PaperRecorder, SimulatedExecutor

SHARD_S = 5.0
CRASH = AttemptReport("a", 5, "crashed", cause="Fatal Python error: Segmentation fault")


class WatchedJobs(Jobs):
    """Real records, and when they were written and read; the stop request is a function of the time."""

    def __init__(self, folder: Path, clock: FakeClock, requested: Callable[[float], Stop | None]) -> None:
        super().__init__(open_storage(folder))
        self.clock, self.requested = clock, requested
        self.states: list[tuple[float, JobState]] = []
        self.looked_s: list[float] = []

    def put_state(self, state: JobState) -> None:
        super().put_state(state)
        self.states.append((self.clock.now_s, state))

    def stop_of(self, job: str) -> Stop | None:
        self.looked_s.append(self.clock.now_s)
        return self.requested(self.clock.now_s)


@dataclass
class Watched:
    """A job of 400 shards on four workers, and what was seen of it."""

    summary: JobSummary
    closed: dict[str, int]
    said: list[dict[str, Any]]
    looked_s: list[float]
    states: list[tuple[float, JobState]]


def watch(
    folder: Path, requested: Callable[[float], Stop | None] = lambda now_s: None, asked: int = 0
) -> Watched:
    clock, out, stop = FakeClock(), io.StringIO(), StopRequest()
    for _ in range(asked):
        stop.ask()
    jobs, books = WatchedJobs(folder, clock, requested), PaperRecorder()
    recorder = JobRecorder(jobs, ("datagen",), "local", shards=400)
    executor = SimulatedExecutor(clock, lambda o, n: ("committed", SHARD_S), slots=4)
    with Progress(True, clock, Console(file=out)) as shown:
        events = JobMonitor(recorder, stop, shown, labels_per_shard=10)
        summary = drive(range(400), lambda o: o, executor, books, RetryPolicy(), events, stop, clock)
    said = [json.loads(line) for line in out.getvalue().splitlines()]
    states = [(at_s, state) for at_s, state in jobs.states if state.phase == "making"]
    return Watched(summary, dict(books.closed), said, jobs.looked_s, states)


def test_state_is_published_every_ten_seconds_and_requests_are_read_every_three(tmp_path: Path) -> None:
    job = watch(tmp_path)
    assert job.summary.end == "complete" and {line["event"] for line in job.said} == {"progress"}
    for times, step_s in (([at_s for at_s, _ in job.states], 10), (job.looked_s, 3)):
        gaps = [b - a for a, b in pairwise(times)]
        assert min(gaps) >= step_s and max(gaps) <= step_s + 1
    done = [state.done for _, state in job.states]
    assert done == sorted(done) and done[-1] > 380
    last = job.states[-1][1]
    assert last.labels_per_s == pytest.approx(4 * 10 / SHARD_S, rel=0.1)
    assert last.left_s is not None and last.left_s == pytest.approx((400 - done[-1]) * 10 / last.labels_per_s)
    assert last.stopping == ""


def test_a_state_can_be_read_when_killed_attempts_had_labels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, jobs = FakeClock(), Jobs(open_storage(tmp_path))
    recorder = JobRecorder(jobs, ("datagen",), "local", shards=4)
    lost = "datagen.cluster.job_monitor.running_attempts"
    monkeypatch.setattr(lost, lambda notes: Running(labels=100 if clock.now_s < 50 else 0))
    with Progress(True, clock, Console(file=io.StringIO())) as shown:
        monitor = JobMonitor(recorder, StopRequest(), shown, labels_per_shard=10)
        for clock.now_s in range(80):
            monitor.tick(JobTotals(4))
    (job,) = jobs.all()
    assert job.state is not None and job.state.labels_per_s == 0


def test_labels_of_rejected_scenes_do_not_hide_the_rate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, jobs = FakeClock(), WatchedJobs(tmp_path, FakeClock(), lambda now_s: None)
    recorder = JobRecorder(jobs, ("datagen",), "local", shards=100)
    seen = "datagen.cluster.job_monitor.running_attempts"
    # Five draws of two scenes of 10 labels, of which the last is kept.
    monkeypatch.setattr(seen, lambda notes: Running(labels=int(2 * clock.now_s) % 100))
    with Progress(True, clock, Console(file=io.StringIO())) as shown:
        monitor = JobMonitor(recorder, StopRequest(), shown, labels_per_shard=10)
        for clock.now_s in range(250):
            done = 2 * (clock.now_s // 50)
            monitor.tick(JobTotals(100, committed=done, labels=10 * done, in_flight=2))
    rates = [state.labels_per_s for _, state in jobs.states][6:]
    assert len(rates) > 15 and all(0.2 < rate < 1.0 for rate in rates)


def test_a_request_drains_the_job_and_is_published_at_once(tmp_path: Path) -> None:
    job = watch(tmp_path, lambda now_s: "drain" if now_s >= 30 else None)
    assert job.summary.end == "interrupted"
    assert [line["reason"] for line in job.said if line["event"] == "stopping"] == ["asked to stop"]
    assert set(job.closed) == {"committed"} and job.summary.totals.committed < 60
    stopping_s = next(at_s for at_s, state in job.states if state.stopping == "asked to stop")
    assert 30 <= stopping_s <= 34 and job.states[-1][1].stopping == "asked to stop"


@pytest.mark.parametrize(
    ("requested", "asked", "cancels"),
    [
        (lambda now_s: "now" if now_s >= 33 else None, 0, True),
        (lambda now_s: "now" if now_s >= 33 else "drain" if now_s >= 30 else None, 0, True),
        (lambda now_s: "drain", 1, False),  # is not a second Ctrl-C
    ],
)
def test_a_request_to_stop_at_once_kills_attempts_in_flight_and_one_to_drain_after_a_ctrl_c_does_not(
    tmp_path: Path, requested: Callable[[float], Stop | None], asked: int, cancels: bool
) -> None:
    job = watch(tmp_path, requested, asked)
    assert job.summary.end == "interrupted" and ("cancelled" in job.closed) == cancels


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


def test_lines_come_at_intervals_and_for_each_failure_as_json_and_as_text() -> None:
    said = [json.loads(line) for line in thirty_seconds(as_json=True)]
    assert [s["event"] for s in said] == ["progress"] * 3 + ["attempt_crashed", "stopping", "progress"]
    assert said[2]["shards_done"] == 80 and said[2]["shards"] == 150
    assert said[2]["labels_per_s"] == 60.0 and said[2]["left_s"] == 70
    assert said[3]["shard"] == 5 and said[3]["action"] == "retry"
    assert thirty_seconds(as_json=False)[2:] == [
        "shards 80/150  60 labels/s  0:01:10 left  0.00 core-h",
        "shard 5 crashed: Fatal Python error: Segmentation fault (retry)",
        "asked to stop: waiting for running attempts; Ctrl-C again stops at once",
        "shards 80/150  60 labels/s  0:01:10 left  0.00 core-h  stopping",
    ]


def test_a_terminal_of_80_columns_shows_all_figures() -> None:
    out, clock = io.StringIO(), FakeClock()
    shown = Progress(clock=clock, console=Console(file=out, force_terminal=True, width=80, color_system=None))
    bar = JobProgress(shown, 60)
    clock.now_s = 40.0
    bar.tick(JobTotals(3000, committed=1400, labels=84_000, retries=3, useful_cpu_s=7200))
    bar.ended(CRASH, "retry")
    shown.close()
    last = [line for line in out.getvalue().splitlines() if "1400/3000" in line][-1]
    assert "2,100 labels/s  0:00:46 left  3 retries  2.00 core-h" in last
    assert "\u2026" not in last and "shard 5 crashed: Fatal Python error" in out.getvalue()

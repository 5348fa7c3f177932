"""The job monitor against a simulated cluster: it publishes its status and polls for stop requests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise

import pytest

from datagen.cluster.driver import drive
from datagen.cluster.job_progress import JobMonitor, JobStatus, StopMode
from datagen.cluster.job_totals import JobSummary
from datagen.cluster.retry_policy import RetryPolicy
from datagen.cluster.stop_request import StopRequest
from tests.cluster.simulated import FakeClock, Heard, PaperRecorder, SimulatedExecutor

SHARD_S = 5.0


@dataclass
class PaperBoard:
    """Remembers what was published and when; the stop request is a function of the time."""

    clock: FakeClock
    requested: Callable[[float], StopMode | None] = lambda now_s: None
    told: list[tuple[float, JobStatus]] = field(default_factory=list)
    looked_s: list[float] = field(default_factory=list)

    def publish(self, status: JobStatus) -> None:
        self.told.append((self.clock.now_s, replace(status, totals=replace(status.totals))))

    def stop_requested(self) -> StopMode | None:
        self.looked_s.append(self.clock.now_s)
        return self.requested(self.clock.now_s)


def watched(
    shards: int,
    requested: Callable[[float], StopMode | None] = lambda now_s: None,
    stop: StopRequest | None = None,
) -> tuple[JobSummary, PaperBoard, PaperRecorder, Heard]:
    clock, recorder, heard = FakeClock(), PaperRecorder(), Heard()
    board, stop = PaperBoard(clock, requested), stop or StopRequest()
    executor = SimulatedExecutor(clock, lambda o, n: ("committed", SHARD_S), slots=4)
    events = JobMonitor(board, stop, labels_per_shard=10, shown=heard, clock=clock)
    summary = drive(range(shards), lambda o: o, executor, recorder, RetryPolicy(), events, stop, clock)
    return summary, board, recorder, heard


def test_it_tells_every_ten_seconds_and_looks_every_three() -> None:
    summary, board, _, heard = watched(400)
    assert summary.end == "complete" and len(heard.actions) == 400
    for times, step_s in (([t for t, _ in board.told], 10), (board.looked_s, 3)):
        gaps = [b - a for a, b in pairwise(times)]
        assert min(gaps) >= step_s and max(gaps) <= step_s + 1
    done = [standing.totals.finished for _, standing in board.told]
    assert done == sorted(done) and done[-1] > 380
    late = board.told[-1][1]
    assert late.labels_per_s == pytest.approx(4 * 10 / SHARD_S, rel=0.1)
    assert late.left_s is not None and late.left_s == pytest.approx((400 - done[-1]) * 10 / late.labels_per_s)
    assert late.stopping == ""


def test_a_request_drains_and_is_told_of_at_once() -> None:
    summary, board, recorder, heard = watched(400, lambda now_s: "drain" if now_s >= 30 else None)
    assert summary.end == "interrupted" and heard.reasons == ["asked to stop"]
    assert set(recorder.closed) == {"committed"} and summary.totals.committed < 60
    told_s = next(t for t, standing in board.told if standing.stopping == "asked to stop")
    assert 30 <= told_s <= 34
    assert [s.stopping for _, s in board.told][-1] == "asked to stop"


def test_a_request_to_end_at_once_ends_what_is_in_flight_by_force() -> None:
    summary, _, recorder, _ = watched(400, lambda now_s: "force" if now_s >= 32 else None)
    assert summary.end == "interrupted" and recorder.closed["cancelled"] == 8


def test_force_may_follow_a_drain() -> None:
    def request(now_s: float) -> StopMode | None:
        return None if now_s < 30 else "drain" if now_s < 33 else "force"

    summary, _, recorder, _ = watched(400, request)
    assert summary.end == "interrupted" and recorder.closed["cancelled"] > 0


def test_a_drain_after_a_ctrl_c_is_not_the_second_ctrl_c() -> None:
    stop = StopRequest()
    stop.ask()
    summary, _, recorder, _ = watched(400, lambda now_s: "drain", stop)
    assert summary.end == "interrupted" and not stop.force and recorder.closed["cancelled"] == 0

"""The driver against a simulated cluster: every ending leads where the policy says."""

from __future__ import annotations

import tracemalloc

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.protocol import JobSummary, JobTotals, StopRequest
from datagen.cluster.shard_policy import RetryPolicy
from datagen.schemas.errors import InputError
from datagen.schemas.run_records import Commit, LedgerEntry
from tests.cluster.bad_cluster import simulate
from tests.cluster.simulated import (
    LENIENT,
    FakeClock,
    Fate,
    Heard,
    PaperRecorder,
    SimulatedExecutor,
    commit_by,
)


def run_script(
    script: dict[int, list[str]], shards: int = 6, policy: RetryPolicy = LENIENT
) -> tuple[JobSummary, PaperRecorder, SimulatedExecutor, Heard]:
    """Shards end as the script says, attempt by attempt, and commit when it has no more to say."""

    def fate(order: AttemptOrder, n: int) -> Fate:
        words = script.get(order.shard, [])
        word = words[n - 1] if n <= len(words) else "committed"
        return (word, None if word == "silent" else 5.0)

    clock = FakeClock()
    executor = SimulatedExecutor(clock, fate, keep_orders=True)
    recorder, heard = PaperRecorder(), Heard()
    summary = drive(range(shards), lambda o: o, executor, recorder, policy, heard, StopRequest(), clock)
    return summary, recorder, executor, heard


@pytest.mark.parametrize("word", ["crashed", "hung", "failed", "out_of_memory", "lost"])
def test_one_failure_is_repeated_and_then_forgotten(word: str) -> None:
    summary, recorder, _, heard = run_script({3: [word]})
    assert summary.end == "complete"
    assert summary.totals.committed == 6 and summary.totals.retries == 1
    assert recorder.closed == {"committed": 6, word: 1}
    assert [a for a in heard.actions if a[0] == 3] == [(3, word, "retry"), (3, "committed", "done")]
    assert summary.totals.labels == 60 and summary.totals.positives == 18


def test_three_failures_of_any_kind_quarantine_the_shard_with_their_causes() -> None:
    summary, recorder, _, _ = run_script({2: ["crashed", "hung", "failed"]})
    trouble = recorder.given_up[2]
    assert trouble.causes == ("crashed: scripted crashed", "hung: scripted hung", "failed: scripted failed")
    assert len(set(trouble.attempts)) == 3
    assert set(recorder.given_up) == {2} and summary.totals.committed == 5
    assert summary.end == "complete"  # within the lenient share


def test_a_job_whose_every_shard_fails_ends_early() -> None:
    script = {shard: ["failed"] * 3 for shard in range(5000)}
    summary, recorder, _, heard = run_script(script, 5000, RetryPolicy(give_up_after=20))
    assert summary.end == "failed"
    assert 51 <= len(recorder.given_up) < 60 and heard.reasons == ["51 shards are quarantined"]
    assert summary.remaining == 5000 - summary.totals.quarantined


def test_a_full_disk_ends_the_job_at_once() -> None:
    summary, recorder, _, heard = run_script({shard: ["failed!"] for shard in range(500) if shard % 5}, 500)
    assert summary.end == "aborted" and summary.cause == "scripted failed!"
    assert summary.totals.finished < 20 and not recorder.given_up
    assert "abort" in {action for _, _, action in heard.actions}


def test_a_silent_attempt_is_ended_by_the_driver_and_counts_as_hung() -> None:
    policy = RetryPolicy(initial_deadline_s=100, max_quarantined_share=1.0)
    summary, recorder, executor, _ = run_script({0: ["silent"]}, policy=policy)
    assert summary.totals.committed == 6 and recorder.closed["hung"] == 1
    first, second = (o for o in executor.orders if o.shard == 0)
    assert second.deadline_s == 2 * first.deadline_s == 200
    cause = next(e.cause for e in recorder.entries if e.outcome == "hung")
    assert "deadline of 100 s" in cause


@pytest.mark.parametrize(("lacks", "outcome"), [("notes", "lost"), ("deaf", "hung")])
def test_a_silent_attempt_is_lost_if_none_began_it_and_hung_if_its_kill_is_never_confirmed(
    lacks: str, outcome: str
) -> None:
    clock, recorder = FakeClock(), PaperRecorder()
    executor = SimulatedExecutor(
        clock,
        lambda o, n: ("committed", None if (o.shard, n) == (0, 1) else 1.0),
        notes=lacks != "notes",
        deaf=lacks == "deaf",
    )
    summary = drive(range(3), lambda o: o, executor, recorder, LENIENT, Heard(), StopRequest(), clock)
    assert summary.totals.committed == 3 and recorder.closed == {"committed": 3, outcome: 1}


def test_a_worker_that_died_after_its_commit_or_lost_the_answer_to_it_has_committed() -> None:
    recorder, clock = PaperRecorder(), FakeClock()
    ends = {1: "crashed", 2: "failed!", 3: "lost", 4: "failed"}  # those of 3 and 4 find another's commit

    def fate(order: AttemptOrder, n: int) -> Fate:
        if order.shard not in ends or n > 1:
            return ("committed" if order.shard == 0 else "superseded", 1.0)
        name = order.attempt if order.shard < 3 else "another"
        recorder.commits[order.shard] = commit_by(order.shard, name, samples=77)
        return (ends[order.shard], 1.0)

    executor = SimulatedExecutor(clock, fate)
    summary = drive(range(5), lambda o: o, executor, recorder, LENIENT, Heard(), StopRequest(), clock)
    assert recorder.closed == {"committed": 3, "superseded": 2, "failed": 1}
    assert summary.end == "complete" and summary.totals.retries == 1
    told = {entry.attempt: entry for entry in recorder.entries}
    for commit in (recorder.commits[shard] for shard in (1, 2)):
        assert told[commit.attempt].cost == commit.cost and told[commit.attempt].cause == ""
    assert summary.totals.labels == 10 + 2 * 77


def test_a_shard_cancelled_by_another_process_is_made() -> None:
    summary, recorder, _, heard = run_script({3: ["cancelled"]})
    assert summary.end == "complete" and summary.totals.committed == 6
    assert recorder.closed == {"committed": 6, "lost": 1} and (3, "lost", "retry") in heard.actions


def stopping_at(
    shard_count: int, asks: int, policy: RetryPolicy, wall_s: float
) -> tuple[JobSummary, PaperRecorder, float]:
    clock, recorder, stop = FakeClock(), PaperRecorder(), StopRequest()
    executor = SimulatedExecutor(clock, lambda o, n: ("committed", wall_s))
    asked_at: list[float] = []

    def on_tick(totals: JobTotals) -> None:
        if totals.committed >= 10 and not asked_at:
            asked_at.append(clock.now_s)
            for _ in range(asks):
                stop.ask()

    summary = drive(
        range(shard_count), lambda o: o, executor, recorder, policy, Heard(on_tick=on_tick), stop, clock
    )
    return summary, recorder, clock.now_s - asked_at[0]


def test_one_request_drains_and_two_end_at_once() -> None:
    summary, recorder, took_s = stopping_at(1000, 1, RetryPolicy(drain_s=30), 500.0)
    assert recorder.closed["cancelled"] > 0 and took_s == pytest.approx(30, abs=2)  # draining is bounded
    summary, recorder, _ = stopping_at(1000, 1, LENIENT, 5.0)
    assert summary.end == "interrupted"
    assert recorder.closed["cancelled"] == 0 and 10 < summary.totals.committed <= 10 + 2 * 4 + 4
    summary, recorder, took_s = stopping_at(1000, 2, LENIENT, 5.0)
    assert summary.end == "interrupted" and recorder.closed["cancelled"] > 0 and took_s < 1
    assert summary.remaining == 1000 - summary.totals.committed
    for summary in (stopping_at(12, 1, LENIENT, 5.0)[0], run_script({}, 0)[0]):  # nothing is left to stop
        assert summary.end == "complete" and summary.remaining == 0


def test_the_window_bounds_what_is_in_flight() -> None:
    for slots in (1, 3, 8):
        clock, recorder = FakeClock(), PaperRecorder()
        executor = SimulatedExecutor(clock, lambda o, n: ("committed", 1.0), slots=slots)
        drive(range(200), lambda o: o, executor, recorder, LENIENT, Heard(), StopRequest(), clock)
        assert executor.most_in_flight == 2 * slots


def test_a_ledger_that_cannot_be_written_ends_attempts_in_flight() -> None:
    class FullLedger(PaperRecorder):
        def close(self, entry: LedgerEntry, commit: Commit | None = None) -> None:
            raise InputError("RUN/ledger", "", "No space left on device", "Free disk space")

    clock = FakeClock()
    executor = SimulatedExecutor(clock, lambda o, n: ("committed", 1.0))
    with pytest.raises(InputError, match="No space left"):
        drive(range(50), lambda o: o, executor, FullLedger(), RetryPolicy(), Heard(), StopRequest(), clock)
    assert executor.in_flight == 0


def test_a_worker_looks_for_a_commit_once_another_attempt_may_have_made_one() -> None:
    for outcome, of_all in (("failed", False), ("superseded", True)):
        clock, recorder, made = FakeClock(), PaperRecorder(), list[AttemptOrder]()

        def end(
            order: AttemptOrder, n: int, outcome: str = outcome, made: list[AttemptOrder] = made
        ) -> tuple[str, float]:
            return outcome if (order.shard, n) == (made[0].shard, 1) else "committed", 1.0

        executor = SimulatedExecutor(clock, end)

        def make(order: AttemptOrder, made: list[AttemptOrder] = made) -> AttemptOrder:
            made.append(order)
            return order

        drive(range(40), make, executor, recorder, LENIENT, Heard(), StopRequest(), clock)
        assert not made[0].may_be_done and made[-1].may_be_done == of_all
        assert all(order.may_be_done for order in made[1:] if order.shard == made[0].shard)


WORDS = st.sampled_from(["crashed", "hung", "failed", "out_of_memory", "lost", "silent", "superseded"])


@settings(max_examples=60, deadline=None)
@given(st.dictionaries(st.integers(0, 11), st.lists(WORDS, max_size=6), max_size=8))
def test_whatever_fails_every_shard_ends_once_and_every_attempt_is_in_the_ledger(
    script: dict[int, list[str]],
) -> None:
    policy = RetryPolicy(initial_deadline_s=10, grace_s=1, max_quarantined_share=1.0, max_lost_rounds=100)
    summary, recorder, executor, heard = run_script(script, 12, policy)
    totals = summary.totals
    assert totals.committed + totals.superseded + totals.quarantined == 12 and summary.remaining == 0
    assert sorted(e.attempt for e in recorder.entries) == sorted(o.attempt for o in executor.orders)
    final = [shard for shard, _, action in heard.actions if action in ("done", "quarantine")]
    assert sorted(final) == list(range(12))
    wall_s = sum(e.cost.wall_s for e in recorder.entries if e.cost)
    assert totals.useful_wall_s + totals.wasted_wall_s == pytest.approx(wall_s)


def test_twenty_thousand_shards_on_a_bad_cluster() -> None:
    """Failures, lost and slow nodes, zombies and doubled reports lead to the right sums, in flat memory."""
    traced: dict[int, int] = {}

    def on_tick(totals: JobTotals) -> None:
        if (thousands := totals.finished // 1000) not in traced:
            traced[thousands] = tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        _, cluster = simulate(20_000, seed=7, on_tick=on_tick)
    finally:
        tracemalloc.stop()
    assert {"committed", "crashed", "failed", "hung", "lost", "out_of_memory"} <= set(cluster.outcomes)
    assert cluster.outcomes["superseded"]
    assert traced[19] - traced[5] < 200_000  # bytes: what 14,000 shards leave behind


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([500, 1500]), st.sampled_from([1, 3, 16]))
def test_the_driver_keeps_its_sums_on_any_bad_cluster(seed: int, shards: int, nodes: int) -> None:
    simulate(shards, seed, nodes)

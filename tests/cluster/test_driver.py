"""The driver against a simulated cluster: every ending leads where the policy says."""

from __future__ import annotations

import random
import tracemalloc
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.cluster.driver import Order, drive
from datagen.cluster.open_shards import OpenShards
from datagen.cluster.policy import Policy
from datagen.cluster.stop import StopRequest
from datagen.cluster.tally import JobSummary, Tally
from datagen.cluster.task import AttemptReport
from datagen.schemas.errors import InputError
from datagen.schemas.run_records import Commit, Cost, Host, LedgerEntry
from datagen.schemas.shard_ranges import ShardRanges
from tests.cluster.bad_cluster import simulate
from tests.cluster.several_drivers import drive_together, waste
from tests.cluster.simulated import FakeClock, Fate, Heard, PaperBooks, SimulatedExecutor, report_of

LENIENT = Policy(max_quarantined_share=1.0)


def run_script(
    script: dict[int, list[str]], shards: int = 6, policy: Policy = LENIENT
) -> tuple[JobSummary, PaperBooks, SimulatedExecutor, Heard]:
    """Shards end as the script says, attempt by attempt, and commit when it has no more to say."""

    def fate(order: Order, n: int) -> Fate:
        words = script.get(order.shard, [])
        word = words[n - 1] if n <= len(words) else "committed"
        return (word, None if word == "silent" else 5.0)

    clock = FakeClock()
    executor = SimulatedExecutor(clock, fate, keep_orders=True)
    books, heard = PaperBooks(), Heard()
    summary = drive(range(shards), lambda o: o, executor, books, policy, heard, StopRequest(), clock)
    return summary, books, executor, heard


@pytest.mark.parametrize("word", ["crashed", "hung", "failed", "out_of_memory", "lost"])
def test_one_failure_is_repeated_and_then_forgotten(word: str) -> None:
    summary, books, _, heard = run_script({3: [word]})
    assert summary.end == "complete" and summary.exit_code == 0
    assert summary.tally.committed == 6 and summary.tally.retries == 1
    assert books.closed == {"committed": 6, word: 1}
    assert [a for a in heard.actions if a[0] == 3] == [(3, word, "retry"), (3, "committed", "done")]
    assert summary.tally.labels == 60 and summary.tally.positives == 18


def test_three_failures_of_any_kind_quarantine_the_shard_with_its_story() -> None:
    summary, books, _, _ = run_script({2: ["crashed", "hung", "failed"]})
    trouble = books.given_up[2]
    assert trouble.causes == ("crashed: scripted crashed", "hung: scripted hung", "failed: scripted failed")
    assert len(set(trouble.attempts)) == 3
    assert summary.tally.quarantined_shards == [2] and summary.tally.committed == 5
    assert summary.end == "complete"  # within the lenient share


def test_lost_machines_have_their_own_budget() -> None:
    summary, books, _, _ = run_script({1: ["lost"] * 9 + ["crashed"] * 2})
    assert summary.tally.committed == 6 and not books.given_up
    _, books, _, _ = run_script({1: ["lost"] * 11})
    assert set(books.given_up) == {1}


class OneMachine(SimulatedExecutor):
    """A machine that loses all that it has been given whenever one attempt is lost."""

    def wait(self, timeout_s: float) -> list[AttemptReport]:
        ended = super().wait(timeout_s)
        if any(report.outcome == "lost" for report in ended):
            ended += [report_of(order, "lost", 0.0) for order in [*self._running.values(), *self._queue]]
            self._running.clear()
            self._queue.clear()
        return ended


def on_one_machine(
    shards: int, fate: Callable[[Order, int], Fate]
) -> tuple[JobSummary, PaperBooks, OneMachine]:
    clock, books = FakeClock(), PaperBooks()
    executor = OneMachine(clock, fate, keep_orders=True)
    summary = drive(range(shards), lambda o: o, executor, books, LENIENT, Heard(), StopRequest(), clock)
    assert len(books.entries) == len(executor.orders) == summary.tally.outcomes.total()
    return summary, books, executor


@pytest.mark.parametrize("shards", [2, 7, 300])
def test_an_executor_that_loses_everything_ends_the_job_and_is_no_shards_fault(shards: int) -> None:
    made = 0

    def fate(order: Order, n: int) -> Fate:
        nonlocal made
        made += shards > 2
        return ("committed", 5.0) if 0 < made <= 3 else ("lost", 0.01)

    summary, books, executor = on_one_machine(shards, fate)
    assert summary.end == "aborted" and summary.exit_code == 2 and not books.given_up
    assert summary.cause == "every attempt is lost, the last by: scripted lost"
    assert summary.remaining == shards - summary.tally.committed and len(executor.orders) < 60


def test_an_executor_that_works_again_completes_the_job() -> None:
    began = 0

    def fate(order: Order, n: int) -> Fate:
        nonlocal began
        began += 1
        return ("lost", 0.1) if began % 40 < 4 else ("committed", 5.0)

    summary, books, _ = on_one_machine(300, fate)
    assert summary.end == "complete" and summary.tally.committed == 300 and not books.given_up


@pytest.mark.parametrize(("shards", "wall_s"), [(1, 1.0), (300, 0.01), (300, 20.0)])
def test_a_shard_that_takes_its_machine_along_is_given_up_alone(shards: int, wall_s: float) -> None:
    def fate(order: Order, n: int) -> Fate:
        return ("lost", wall_s) if order.shard == shards // 3 else ("committed", 5.0)

    summary, books, executor = on_one_machine(shards, fate)
    assert set(books.given_up) == {shards // 3} and summary.tally.committed == shards - 1
    assert len(executor.orders) <= shards + 11 * 8
    assert max(Counter(e.shard for e in books.entries if e.shard != shards // 3).values(), default=0) <= 5


def test_out_of_memory_is_tried_once_more() -> None:
    summary, _, _, _ = run_script({4: ["out_of_memory"]})
    assert summary.tally.committed == 6
    _, books, executor, _ = run_script({4: ["out_of_memory"] * 5})
    assert set(books.given_up) == {4}
    assert len([o for o in executor.orders if o.shard == 4]) == 2


def test_the_share_of_quarantined_shards_decides_the_exit_status() -> None:
    bad = {2: ["failed"] * 3}
    assert run_script(bad, 100, Policy(max_quarantined_share=0.01))[0].exit_code == 0
    assert run_script(bad, 99, Policy(max_quarantined_share=0.01))[0].exit_code == 1


def test_a_job_whose_every_shard_fails_ends_early() -> None:
    script = {shard: ["failed"] * 3 for shard in range(5000)}
    summary, books, _, heard = run_script(script, 5000, Policy(give_up_after=20))
    assert summary.end == "failed" and summary.exit_code == 1
    assert 51 <= len(books.given_up) < 60 and heard.reasons == ["51 shards are quarantined"]
    assert summary.remaining == 5000 - summary.tally.quarantined


def test_a_full_disk_ends_the_job_at_once() -> None:
    summary, books, _, heard = run_script({shard: ["failed!"] for shard in range(500) if shard % 5}, 500)
    assert summary.end == "aborted" and summary.exit_code == 2 and summary.cause == "scripted failed!"
    assert summary.tally.finished < 20 and not books.given_up
    assert "abort" in {action for _, _, action in heard.actions}


def test_a_silent_attempt_is_ended_by_the_driver_and_counts_as_hung() -> None:
    policy = Policy(initial_deadline_s=100, max_quarantined_share=1.0)
    summary, books, executor, _ = run_script({0: ["silent"]}, policy=policy)
    assert summary.tally.committed == 6 and books.closed["hung"] == 1
    first, second = (o for o in executor.orders if o.shard == 0)
    assert second.deadline_s == 2 * first.deadline_s == 200
    cause = next(e.cause for e in books.entries if e.outcome == "hung")
    assert "deadline of 100 s" in cause


def test_an_attempt_that_no_worker_began_is_lost_and_not_hung() -> None:
    clock, books = FakeClock(), PaperBooks()
    executor = SimulatedExecutor(
        clock, lambda o, n: ("committed", None if (o.shard, n) == (0, 1) else 1.0), notes=False
    )
    policy = Policy(initial_deadline_s=100)
    summary = drive(range(3), lambda o: o, executor, books, policy, Heard(), StopRequest(), clock)
    assert summary.tally.committed == 3 and books.closed == {"committed": 3, "lost": 1}


def test_an_executor_that_never_confirms_a_kill_does_not_hold_the_driver() -> None:
    clock, books = FakeClock(), PaperBooks()
    executor = SimulatedExecutor(
        clock, lambda o, n: ("committed", None if (o.shard, n) == (0, 1) else 1.0), deaf=True
    )
    summary = drive(range(3), lambda o: o, executor, books, LENIENT, Heard(), StopRequest(), clock)
    assert summary.tally.committed == 3 and books.closed["hung"] == 1


def test_a_worker_that_died_after_its_commit_has_committed() -> None:
    books, clock, name = PaperBooks(), FakeClock(), {}

    def fate(order: Order, n: int) -> Fate:
        if order.shard == 1:
            name[1] = order.attempt
            books.commits[1] = commit_by(1, order.attempt)
            return ("crashed", 1.0)
        if order.shard == 2:
            books.commits[2] = commit_by(2, "another")
            return ("lost", 1.0)
        return ("committed", 1.0)

    executor = SimulatedExecutor(clock, fate)
    summary = drive(range(4), lambda o: o, executor, books, LENIENT, Heard(), StopRequest(), clock)
    assert books.closed == {"committed": 3, "superseded": 1} and summary.tally.retries == 0
    assert summary.end == "complete"
    entry = next(e for e in books.entries if e.attempt == name[1])
    assert entry.cost == books.commits[1].cost and entry.cause == ""
    assert summary.tally.labels == 2 * 10 + 77


def test_a_worker_that_lost_the_answer_to_its_commit_has_committed() -> None:
    books, clock = PaperBooks(), FakeClock()

    def fate(order: Order, n: int) -> Fate:
        if order.shard == 1:
            books.commits[1] = commit_by(1, order.attempt)
            return ("failed!", 1.0)
        if order.shard == 2 and n == 1:
            books.commits[2] = commit_by(2, "another")
            return ("failed", 1.0)
        return ("superseded" if order.shard == 2 else "committed", 1.0)

    executor = SimulatedExecutor(clock, fate)
    summary = drive(range(4), lambda o: o, executor, books, LENIENT, Heard(), StopRequest(), clock)
    assert summary.end == "complete"
    assert books.closed == {"committed": 3, "failed": 1, "superseded": 1}


def test_a_shard_that_somebody_else_cancels_is_made_all_the_same() -> None:
    summary, books, _, heard = run_script({3: ["cancelled"]})
    assert summary.end == "complete" and summary.tally.committed == 6
    assert books.closed == {"committed": 6, "lost": 1} and (3, "lost", "retry") in heard.actions


def commit_by(shard: int, attempt: str) -> Commit:
    host = Host(name="h", cpu="c", cores=1, memory_bytes=1)
    return Commit(
        shard=shard, attempt=attempt, spec_hash="0" * 64, scenes=1, samples=77, positives=7, redraws={},
        files=(), cost=Cost(wall_s=4, cpu_s=4), host=host, created="",
    )  # fmt: skip


def stopping_at(
    shard_count: int, asks: int, policy: Policy, wall_s: float
) -> tuple[JobSummary, PaperBooks, float]:
    clock, books, stop = FakeClock(), PaperBooks(), StopRequest()
    executor = SimulatedExecutor(clock, lambda o, n: ("committed", wall_s))
    asked_at: list[float] = []

    def on_tick(tally: Tally) -> None:
        if tally.committed >= 10 and not asked_at:
            asked_at.append(clock.now_s)
            for _ in range(asks):
                stop.ask()

    summary = drive(
        range(shard_count), lambda o: o, executor, books, policy, Heard(on_tick=on_tick), stop, clock
    )
    return summary, books, clock.now_s - asked_at[0]


def test_one_request_drains_and_two_end_at_once() -> None:
    summary, books, _ = stopping_at(1000, 1, LENIENT, 5.0)
    assert summary.end == "interrupted" and summary.exit_code == 130
    assert books.closed["cancelled"] == 0 and 10 < summary.tally.committed <= 10 + 2 * 4 + 4
    summary, books, took_s = stopping_at(1000, 2, LENIENT, 5.0)
    assert summary.end == "interrupted" and books.closed["cancelled"] > 0 and took_s < 1
    assert summary.remaining == 1000 - summary.tally.committed


def test_a_stop_that_leaves_nothing_to_do_is_none() -> None:
    summary, _, _ = stopping_at(12, 1, LENIENT, 5.0)
    assert summary.remaining == 0
    assert summary.end == "complete" and summary.exit_code == 0


def test_draining_is_bounded() -> None:
    _, books, took_s = stopping_at(1000, 1, Policy(drain_s=30), 500.0)
    assert books.closed["cancelled"] > 0 and took_s == pytest.approx(30, abs=2)


def test_the_window_bounds_what_is_in_flight() -> None:
    for slots in (1, 3, 8):
        clock = FakeClock()
        executor = SimulatedExecutor(clock, lambda o, n: ("committed", 1.0), slots=slots)
        drive(range(200), lambda o: o, executor, PaperBooks(), Policy(), Heard(), StopRequest(), clock)
        assert executor.most_in_flight == 2 * slots


def test_books_that_cannot_be_written_end_what_is_in_flight() -> None:
    class FullBooks(PaperBooks):
        def close(self, entry: LedgerEntry) -> None:
            raise InputError("RUN/ledger", "", "No space left on device", "Free disk space")

    clock = FakeClock()
    executor = SimulatedExecutor(clock, lambda o, n: ("committed", 1.0))
    with pytest.raises(InputError, match="No space left"):
        drive(range(50), lambda o: o, executor, FullBooks(), Policy(), Heard(), StopRequest(), clock)
    assert executor.in_flight == 0


def test_no_shards_is_a_complete_job() -> None:
    summary, _, _, _ = run_script({}, 0)
    assert summary.end == "complete" and summary.exit_code == 0


WORDS = st.sampled_from(["crashed", "hung", "failed", "out_of_memory", "lost", "silent", "superseded"])


@settings(max_examples=60, deadline=None)
@given(st.dictionaries(st.integers(0, 11), st.lists(WORDS, max_size=6), max_size=8))
def test_whatever_fails_every_shard_ends_once_and_every_attempt_is_in_the_ledger(
    script: dict[int, list[str]],
) -> None:
    policy = Policy(initial_deadline_s=10, grace_s=1, max_quarantined_share=1.0, max_lost_rounds=100)
    summary, books, executor, heard = run_script(script, 12, policy)
    tally = summary.tally
    assert tally.committed + tally.superseded + tally.quarantined == 12 and summary.remaining == 0
    assert sorted(e.attempt for e in books.entries) == sorted(o.attempt for o in executor.orders)
    final = [shard for shard, _, action in heard.actions if action in ("done", "quarantine")]
    assert sorted(final) == list(range(12))
    wall_s = sum(e.cost.wall_s for e in books.entries if e.cost)
    assert tally.useful_wall_s + tally.wasted_wall_s == pytest.approx(wall_s)


class Other:
    """Another driver with as many slots, begun at the same moment: it goes through the shards in order."""

    def __init__(self, clock: FakeClock, shards: int, slots: int) -> None:
        self.clock, self.shards, self.slots = clock, shards, slots
        self.done: set[int] = set()
        self.ours: set[int] = set()
        self.at, self.step_s = 0, 0.0

    def advance(self) -> None:
        while self.step_s + 5.0 <= self.clock.now_s:
            self.step_s += 5.0
            for _ in range(self.slots):
                while self.at in self.ours:
                    self.at += 1
                if self.at < self.shards:
                    self.done.add(self.at)
                    self.at += 1

    def fate(self, order: Order, n: int) -> Fate:
        self.advance()
        if order.shard in self.done:
            return ("superseded", 0.01)
        if self.at <= order.shard < self.at + self.slots:  # at work there now
            return ("superseded", 5.0)
        self.ours.add(order.shard)
        return ("committed", 5.0)


@pytest.mark.parametrize("shards", [40, 400, 4000])
def test_a_driver_makes_way_for_another(shards: int) -> None:
    clock = FakeClock()
    other = Other(clock, shards, slots=4)

    class SharedBooks(PaperBooks):
        def missing(self) -> ShardRanges:
            other.advance()
            return ShardRanges.of(range(shards)).without(ShardRanges.of(other.done | other.ours))

    books = SharedBooks()
    executor = SimulatedExecutor(clock, other.fate, slots=4)
    summary = drive(range(shards), lambda o: o, executor, books, LENIENT, Heard(), StopRequest(), clock)
    tally = summary.tally
    assert summary.end == "complete" and summary.remaining == 0
    clock.now_s += 5.0 * shards  # what the other is at work at counts as done here
    other.advance()
    assert tally.committed == len(other.ours) and other.done | other.ours == set(range(shards))
    assert tally.committed + tally.superseded + tally.elsewhere == shards
    # Places are drawn at random. Over few shards the two may meet until the end; over many they share them.
    assert shards == 40 or tally.committed > shards // 3
    # Twice the first window, and some more wherever the two met: no longer everything.
    assert shards == 40 or tally.wasted_wall_s <= 5.0 * (64 + shards // 50)


@given(st.sets(st.integers(0, 80)), st.integers(0, 2**32), st.lists(st.integers(0, 3), max_size=80))
def test_open_shards_are_given_once_or_dropped(shards: set[int], seed: int, moves: list[int]) -> None:
    rng, open_ = random.Random(seed), OpenShards(sorted(shards), random.Random(seed))
    given_out: list[int] = []
    dropped: set[int] = set()
    for move in moves:
        if move == 0:
            open_.go_elsewhere()
        elif move == 1:
            gone = {shard for shard in shards if rng.random() < 0.2}
            dropped |= gone - set(given_out)
            before = len(open_)
            assert open_.keep(ShardRanges.of(shards - gone)) == before - len(open_)
        elif (shard := open_.next()) is not None:
            given_out.append(shard)
    while (shard := open_.next()) is not None:
        given_out.append(shard)
    assert len(open_) == 0 and len(set(given_out)) == len(given_out)
    assert set(given_out) | dropped == shards and not set(given_out) & dropped


@pytest.mark.parametrize(
    ("drivers", "shards", "attempts", "share"),
    # Wasted attempts and their share of all time, at most, in the mean. Two slots and four attempts in
    # flight a driver: of ten shards, four drivers cannot but make some twice.
    [(2, 10, 11, 0.36), (4, 10, 23, 0.53), (2, 100, 22, 0.11), (4, 100, 48, 0.19)],
)
def test_drivers_that_begin_together_waste_little(
    drivers: int, shards: int, attempts: float, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = np.random.default_rng(0)
    monkeypatch.setattr("datagen.cluster.driver.secrets.token_hex", lambda n: names.bytes(n).hex())
    wasted = []
    for _ in range(12):
        summaries = drive_together(drivers, shards)
        assert sum(summary.tally.committed for summary in summaries) == shards
        assert all(summary.end == "complete" and not summary.remaining for summary in summaries)
        wasted.append(waste(summaries))
    assert np.all(np.mean(wasted, axis=0) <= (attempts, share))


def test_open_shards_come_in_order_while_nobody_else_is_there() -> None:
    for seed in range(20):
        open_ = OpenShards([7, 3, 4, 1], random.Random(seed))
        given_out = [open_.next() for _ in range(5)]
        assert given_out[4] is None and sorted(given_out[:4]) == [1, 3, 4, 7]
        at = given_out.index(1)
        assert given_out[at:4] + given_out[:at] == [1, 3, 4, 7]  # from the first one behind the last
    open_ = OpenShards(range(10), random.Random(0))
    at = open_.next()
    assert open_.next() == (at + 1) % 10
    left = [(at + ahead) % 10 for ahead in (2, 3, 8, 9)]
    assert open_.keep(ShardRanges.of(left)) == 4  # others are far ahead: it stays here
    assert [open_.next() for _ in range(5)] == [*left, None]


def test_twenty_thousand_shards_on_a_bad_cluster() -> None:
    """Failures, lost and slow nodes, zombies and doubled reports lead to the right sums, in flat memory."""
    traced: dict[int, int] = {}

    def on_tick(tally: Tally) -> None:
        if (thousands := tally.finished // 1000) not in traced:
            traced[thousands] = tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        _, cluster = simulate(20_000, seed=7, on_tick=on_tick)
    finally:
        tracemalloc.stop()
    assert {"committed", "crashed", "failed", "hung", "lost", "out_of_memory", "superseded"} <= set(
        cluster.outcomes
    )
    assert traced[19] - traced[5] < 200_000  # bytes: what 14,000 shards leave behind


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([500, 1500]), st.sampled_from([1, 3, 16]))
def test_any_bad_cluster_ends_right(seed: int, shards: int, nodes: int) -> None:
    simulate(shards, seed, nodes)

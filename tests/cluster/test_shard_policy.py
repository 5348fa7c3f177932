"""The policy alone: pure functions of plain values."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.cluster.protocol import AttemptReport
from datagen.cluster.shard_policy import (
    Durations,
    RetryPolicy,
    ShardFailures,
    at_once,
    deadline_s,
    decide,
    ends_early,
    nothing_runs,
    percentile_95,
    too_many_quarantined,
)
from datagen.schemas.run_records import Outcome

POLICY = RetryPolicy()


def follow(outcomes: list[Outcome]) -> tuple[list[str], ShardFailures, list[float]]:
    """Actions, the trouble at the end and the waits of a shard whose attempts end like this."""
    trouble, actions, waits = ShardFailures(), [], []
    for n, outcome in enumerate(outcomes):
        decision = decide(POLICY, trouble, AttemptReport(f"a{n}", 0, outcome, cause="why"), alone=True)
        actions.append(decision.action)
        waits.append(decision.wait_s)
        trouble = decision.trouble
    return actions, trouble, waits


@pytest.mark.parametrize(
    ("outcomes", "last"),
    [
        (["crashed", "hung", "failed"], "quarantine"),
        (["crashed", "lost", "lost", "crashed"], "retry"),
        (["lost"] * 9, "retry"),
        (["lost"] * 10, "quarantine"),
        (["out_of_memory"], "retry"),
        (["out_of_memory", "crashed", "out_of_memory"], "quarantine"),
        (["crashed", "committed"], "done"),
        (["crashed", "superseded"], "done"),
        (["cancelled"], "drop"),
    ],
)
def test_budgets_and_waits_that_double_up_to_a_limit(outcomes: list[Outcome], last: str) -> None:
    actions, trouble, waits = follow(outcomes)
    assert actions[-1] == last
    retried = [wait_s for wait_s, action in zip(waits, actions, strict=True) if action == "retry"]
    assert retried == [0.5, 1, 2, 4, 8, 16, 32, 60, 60][: len(retried)]
    troubles = [o for o in outcomes if o not in ("committed", "superseded", "cancelled")]
    assert [c.split(":")[0] for c in trouble.causes] == troubles


def test_a_loss_counts_where_the_shard_was_alone_or_others_succeeded_since_its_last() -> None:
    trouble, lost = ShardFailures(), AttemptReport("a", 0, "lost")
    for successes, alone, counted in (
        (0, False, 0),
        (3, False, 1),
        (3, False, 1),
        (3, True, 2),
        (4, False, 3),
    ):
        trouble = decide(POLICY, trouble, lost, successes, alone).trouble
        assert trouble.lost == counted
    for _ in range(100):  # a cluster that is gone
        assert decide(POLICY, trouble, lost, successes=4).action == "retry"
    assert decide(POLICY, replace(trouble, lost=9), lost, successes=5).action == "quarantine"


def test_losses_in_a_row_are_the_executors_fault_and_never_before_a_lone_shards_budget_is_spent() -> None:
    assert [nothing_runs(POLICY, lost, width=4) for lost in (20, 21)] == [False, True]
    assert [nothing_runs(POLICY, lost, width=1) for lost in (11, 12)] == [False, True]
    # The first of its losses may not count.
    trouble, actions = ShardFailures(), []
    for _ in range(11):
        decision = decide(POLICY, trouble, AttemptReport("a", 0, "lost"), alone=bool(actions))
        trouble, actions = decision.trouble, [*actions, decision.action]
    assert actions == ["retry"] * 10 + ["quarantine"]
    # After two rounds of losses shards are tried one at a time, early enough that one which takes the others
    # along can be told before the job is ended.
    assert [at_once(lost, width=4) for lost in (0, 7, 8, 100)] == [4, 4, 1, 1]
    assert at_once(100, width=1) == 1
    assert all(not nothing_runs(POLICY, 2 * width, width) for width in range(1, 100))


def test_shares_of_quarantined_shards_and_of_few_that_end_a_job_early() -> None:
    assert not too_many_quarantined(POLICY, 0, 0) and not too_many_quarantined(POLICY, 30, 3000)
    assert too_many_quarantined(POLICY, 31, 3000) and too_many_quarantined(POLICY, 1, 10)
    assert not ends_early(POLICY, 19, 100) and ends_early(POLICY, 20, 100)


def test_deadlines_follow_what_attempts_took() -> None:
    durations = Durations()
    assert deadline_s(POLICY, durations, ShardFailures()) == POLICY.initial_deadline_s
    for _ in range(20):
        durations.add(30.0)
    assert deadline_s(POLICY, durations, ShardFailures()) == 300.0
    assert deadline_s(POLICY, durations, ShardFailures(hangs=2)) == 1200.0
    for _ in range(400):
        durations.add(0.01)
    assert deadline_s(POLICY, durations, ShardFailures()) == POLICY.min_deadline_s


@given(st.lists(st.floats(0, 1e6), min_size=1, max_size=200))
def test_the_percentile_is_a_value_that_95_in_100_do_not_exceed(values: list[float]) -> None:
    p = percentile_95(values)
    assert p in values
    assert sum(v <= p for v in values) >= 0.95 * len(values)
    assert sum(v < p for v in values) < 0.95 * len(values)

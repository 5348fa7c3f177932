"""What a driver writes down of a real run, and what it closes for one that was killed."""

from __future__ import annotations

from pathlib import Path

from datagen.cluster.run_recorder import RunRecorder, close_lost_attempts
from datagen.cluster.shard_policy import ShardFailures
from datagen.schemas.run import Run
from datagen.schemas.run_records import Cost, LedgerEntry
from tests.made_runs import make_run, write

TROUBLE = ShardFailures(attempts=("a", "b"), causes=("failed: x", "hung: y"), stacks=("at x", ""))


def ends(run: Run) -> dict[str, LedgerEntry]:
    return {entry.attempt: entry for entry in run.ledger.ends()}


def test_attempts_of_a_killed_driver_are_closed_once_their_shards_are_decided(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", shards=())
    for attempt, shard in (("lost-one", 0), ("won-one", 1), ("orphan", 2), ("hopeless", 3)):
        run.ledger.start(attempt, shard)
    run.commit(write(run, 0, "by-the-next-driver"))
    run.commit(write(run, 1, "won-one"))
    RunRecorder(run).quarantine(3, TROUBLE)
    # Nobody knows yet whether the orphan will reach its commit.
    assert close_lost_attempts(run) == 3 and close_lost_attempts(run) == 0
    assert [start.attempt for start in run.ledger.unfinished()] == ["orphan"]
    run.commit(write(run, 2, "orphan"))
    assert close_lost_attempts(run) == 1
    told = {name: (entry.outcome, entry.shard) for name, entry in ends(run).items()}
    assert told == {
        "lost-one": ("lost", 0), "won-one": ("committed", 1), "orphan": ("committed", 2),
        "hopeless": ("lost", 3),
    }  # fmt: skip


def test_a_closed_attempt_has_all_that_is_known(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", shards=())
    for attempt, shard in (("lost", 0), ("won", 1)):
        run.ledger.start(attempt, shard)
    run.commit(write(run, 0, "other"))
    run.commit(write(run, 1, "won"))
    starts = {start.attempt: start for start in run.ledger.unfinished()}
    close_lost_attempts(run)
    commit, found = run.commit_of(1), ends(run)
    assert found["won"] == LedgerEntry(
        attempt="won",
        shard=1,
        outcome="committed",
        started=starts["won"].started,
        ended=commit.created,
        cost=commit.cost,
        host=commit.host,
    )
    lost = found["lost"]
    assert lost.cause == "it left no end record, and its shard was decided without it"
    assert (lost.cost, lost.host, lost.started) == (None, None, starts["lost"].started)
    assert lost.ended >= lost.started > ""


def test_a_shard_in_quarantine_can_be_run_alone(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", shards=())
    RunRecorder(run).quarantine(3, TROUBLE)
    (record,) = run.quarantine_records()
    assert (record.shard, record.seed, record.first_scene, record.scenes) == (3, 0, 6, 2)
    assert (record.attempts, record.causes, record.stacks) == (
        TROUBLE.attempts,
        TROUBLE.causes,
        TROUBLE.stacks,
    )


def test_an_attempt_taken_for_lost_replaces_that_by_its_own_account(tmp_path: Path) -> None:
    """Two drivers at once: the first to end closes what the other still has in flight."""
    run = make_run(tmp_path / "run", shards=())
    run.ledger.start("slow", 0)
    run.commit(write(run, 0, "fast"))
    assert close_lost_attempts(run) == 1
    recorder, cost = RunRecorder(run), Cost(wall_s=7.0, cpu_s=6.0)
    for seconds in (7.0, 9.0):  # an account stands, whoever comes later
        told = LedgerEntry(attempt="slow", shard=0, outcome="superseded", cost=Cost(wall_s=seconds, cpu_s=6))
        recorder.close(told)
    (entry,) = run.ledger.ends()
    assert (entry.outcome, entry.cost) == ("superseded", cost)

"""What a driver writes down of a real run, and what it closes for one that was killed."""

from __future__ import annotations

from pathlib import Path

from datagen.cluster.run_recorder import RunRecorder
from datagen.cluster.shard_policy import ShardFailures
from datagen.schemas.run_records import Cost, LedgerEntry
from tests.made_runs import make_run, write

TROUBLE = ShardFailures(attempts=("a", "b"), causes=("failed: x", "hung: y"), stacks=("at x", ""))


def test_attempts_of_a_killed_driver_are_closed_once_their_shards_are_decided(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", shards=())
    for attempt, shard in (("lost-one", 0), ("won-one", 1), ("orphan", 2), ("hopeless", 3)):
        run.ledger.start(attempt, shard)
    run.commit(write(run, 0, "by-the-next-driver"))
    won = write(run, 1, "won-one")
    run.commit(won)
    RunRecorder(run).quarantine(3, TROUBLE)
    # Nobody knows yet whether the orphan will reach its commit.
    starts = {start.attempt: start for start in run.ledger.unfinished({"won-one"})}
    assert run.close_lost_attempts() == 2 and run.close_lost_attempts() == 0
    RunRecorder(run).close(LedgerEntry(attempt="won-one", shard=1, outcome="committed", cost=won.cost))
    assert [start.attempt for start in run.ledger.unfinished({"won-one"})] == ["orphan"]
    run.commit(write(run, 2, "orphan"))
    assert run.close_lost_attempts() == 0  # its commit is its account
    ends = {entry.attempt: entry for entry in run.ledger.ends()}
    assert {name: (entry.outcome, entry.shard) for name, entry in ends.items()} == {
        "lost-one": ("lost", 0), "hopeless": ("lost", 3),
    }  # fmt: skip
    lost = ends["lost-one"]
    assert lost.cause == "it left no record, and its shard was decided without it"
    assert (lost.cost, lost.host, lost.started) == (None, None, starts["lost-one"].started)
    assert lost.ended >= lost.started > ""
    (record,) = run.quarantine_records()  # with which the shard can be run alone
    assert (record.shard, record.seed, record.first_scene, record.scenes) == (3, 0, 6, 2)
    assert (record.attempts, record.causes) == (TROUBLE.attempts, TROUBLE.causes)
    assert record.stacks == TROUBLE.stacks


def test_an_attempt_taken_for_lost_replaces_that_by_its_own_account(tmp_path: Path) -> None:
    """Two drivers at once: the first to end closes what the other still has in flight."""
    run = make_run(tmp_path / "run", shards=())
    run.ledger.start("slow", 0)
    run.commit(write(run, 0, "fast"))
    assert run.close_lost_attempts() == 1
    for seconds in (7.0, 9.0):  # an account stands, whoever comes later
        cost = Cost(wall_s=seconds, cpu_s=6)
        RunRecorder(run).close(LedgerEntry(attempt="slow", shard=0, outcome="superseded", cost=cost))
    (entry,) = run.ledger.ends()
    assert (entry.outcome, entry.cost) == ("superseded", Cost(wall_s=7.0, cpu_s=6.0))

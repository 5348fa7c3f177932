"""The driver's records in a run: how attempts ended, which shards were given up, what was lost."""

from __future__ import annotations

from cluster.guard import utc_now
from cluster.policy import Trouble
from schemas.run import Run, commit_key
from schemas.run_records import Commit, LedgerEntry, QuarantineRecord


class RunBooks:
    """Writes the ledger and the quarantine of one run."""

    def __init__(self, run: Run) -> None:
        self._run = run

    def close(self, entry: LedgerEntry) -> None:
        """Note how an attempt ended. An end that was noted before stands, unless it was a guess."""
        self._run.ledger.end(entry)

    def quarantine(self, shard: int, trouble: Trouble) -> None:
        """Give a shard up, with all that is needed to run it alone."""
        scenes = self._run.layout.scenes_per_shard
        self._run.quarantine(
            QuarantineRecord(
                shard=shard,
                seed=self._run.manifest.spec.seed,
                first_scene=shard * scenes,
                scenes=scenes,
                attempts=trouble.attempts,
                causes=trouble.causes,
                stacks=trouble.stacks,
                created=utc_now(),
            )
        )

    def commit_of(self, shard: int) -> Commit | None:
        """The shard's commit record, or None while there is none."""
        return self._run.commit_of(shard) if self._run.storage.exists(commit_key(shard)) else None


def close_lost_attempts(run: Run) -> int:
    """Close in the ledger what a former driver left open; return how many attempts that were.

    Call it when a job has ended. An attempt that began and never ended belonged to a driver that
    was killed; its worker may outlive the driver by moments and still reach its commit. So an
    attempt is judged only once its shard is decided: the one that won is closed as committed, at
    the commit's cost, others as lost, at a cost that nobody knows; where the driver lives after
    all, its own note replaces this one. Where the shard is still open they stay open, for the job
    that resumes.
    """
    books, quarantined, closed = RunBooks(run), run.quarantined(), 0
    for start in run.ledger.unfinished():
        commit = books.commit_of(start.shard)
        if commit is None and start.shard not in quarantined:
            continue
        if commit is not None and commit.attempt == start.attempt:
            entry = LedgerEntry(
                attempt=start.attempt,
                shard=start.shard,
                outcome="committed",
                started=start.started,
                ended=commit.created,
                cost=commit.cost,
                host=commit.host,
            )
        else:
            entry = LedgerEntry(
                attempt=start.attempt,
                shard=start.shard,
                outcome="lost",
                cause="it left no end, and its shard was decided without it",
                started=start.started,
                ended=utc_now(),
            )
        books.close(entry)
        closed += 1
    return closed

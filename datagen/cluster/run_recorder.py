"""Records how the attempts of a run ended, its quarantined shards and lost attempts."""

from __future__ import annotations

from datagen.cluster.shard_policy import ShardFailures
from datagen.schemas.record_files import commit_key, utc_now
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit, LedgerEntry, QuarantineRecord
from datagen.schemas.shard_ranges import ShardRanges


class RunRecorder:
    """Writes the ledger and the quarantine of one run."""

    def __init__(self, run: Run) -> None:
        self._run = run

    def close(self, entry: LedgerEntry, commit: Commit | None = None) -> None:
        """Record how an attempt ended, unless its commit does. An earlier record is kept if not a guess."""
        if commit is not None:
            self._run.remember(commit)
        if entry.outcome != "committed":
            self._run.ledger.end(entry)

    def quarantine(self, shard: int, trouble: ShardFailures) -> None:
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
        self._run.refuse_replaced()
        return self._run.commit_of(shard) if self._run.storage.exists(commit_key(shard)) else None

    def missing(self) -> ShardRanges:
        return self._run.missing()

"""The ledger of a run: start, outcome and cost of every attempt."""

from __future__ import annotations

import platform
import secrets
from collections.abc import Iterator

from datagen.schemas.errors import InputError
from datagen.schemas.record_files import encode_record, read_record, read_records, utc_now
from datagen.schemas.run_records import AttemptStart, Commit, LedgerEntry
from datagen.schemas.storage import Storage

MAX_STACK_CHARS = 20_000
LOST_CAUSE = "it left no end record, and its shard was decided without it"


class Ledger:
    """Two records per attempt, its start and its end, under `ledger/` of a run's storage."""

    def __init__(self, storage: Storage) -> None:
        self._storage = storage

    def start(self, attempt: str, shard: int) -> None:
        """Record that an attempt begins. InputError for two attempts of one name, which is a defect."""
        record = AttemptStart(
            attempt=attempt, shard=shard, started=utc_now(), host=platform.node(), writer=secrets.token_hex(8)
        )
        if not self._storage.put_new(start_key(attempt), encode_record(record)):
            place = f"{self._storage.url}/{start_key(attempt)}"
            raise InputError(place, "", "exists already", "Give every attempt its own name")

    def end(self, entry: LedgerEntry) -> bool:
        """Record how an attempt ended; False when its end was recorded before. Long stacks are cut.

        The end of an attempt that another job recorded as lost replaces that guess. Where the start record is
        missing, it is written here, so that every end has one.
        """
        if entry.outcome not in ("committed", "superseded") and not self._storage.exists(
            start_key(entry.attempt)
        ):
            self._storage.put_new(start_key(entry.attempt), encode_record(start_from_end(entry)))
        kept = entry.model_copy(
            update={"stack": entry.stack[-MAX_STACK_CHARS:], "cause": entry.cause[:MAX_STACK_CHARS]}
        )
        key = end_key(entry.attempt)
        if self._storage.put_new(key, encode_record(kept)):
            return True
        noted = self.end_of(entry.attempt)
        if kept.cost is None or noted is None or noted.outcome != "lost" or noted.cost is not None:
            return False
        self._storage.put(key, encode_record(kept))
        self._storage.sync([key])
        return True

    def attempts(self) -> set[str]:
        return {name.removesuffix(".start") for name in self._names()}

    def start_of(self, attempt: str) -> AttemptStart | None:
        return read_record(self._storage, start_key(attempt), AttemptStart)

    def end_of(self, attempt: str) -> LedgerEntry | None:
        """The end record of an attempt; None while it has not ended."""
        return read_record(self._storage, end_key(attempt), LedgerEntry)

    def ends(self) -> Iterator[LedgerEntry]:
        names = sorted(name for name in self._names() if not name.endswith(".start"))
        return read_records(self._storage, map(end_key, names), LedgerEntry)

    def unfinished(self) -> list[AttemptStart]:
        """Start records of attempts without an end: running, or lost."""
        names = self._names()
        began = (name.removesuffix(".start") for name in names if name.endswith(".start"))
        open_ = sorted(attempt for attempt in began if attempt not in names)
        return list(read_records(self._storage, map(start_key, open_), AttemptStart))

    def _names(self) -> set[str]:
        """Names of all records, by listing; those of starts end in `.start`."""
        return {
            file.key[len("ledger/") : -len(".json")]
            for file in self._storage.list("ledger")
            if file.key.endswith(".json")
        }


def end_from_commit(commit: Commit, started: str) -> LedgerEntry:
    """The end record of a committed attempt, with the commit's cost; `started` is "" where unknown."""
    return LedgerEntry(
        attempt=commit.attempt,
        shard=commit.shard,
        outcome="committed",
        started=started,
        ended=commit.created,
        cost=commit.cost,
        host=commit.host,
    )


def lost_end(start: AttemptStart, ended: str = "", cause: str = LOST_CAUSE) -> LedgerEntry:
    """The end record of an attempt that left none, with unknown cost.

    It is a guess, made once the shard is decided: the attempt, if still running, may replace it.
    """
    return LedgerEntry(
        attempt=start.attempt,
        shard=start.shard,
        outcome="lost",
        cause=cause,
        started=start.started,
        ended=ended,
    )


def start_from_end(end: LedgerEntry) -> AttemptStart:
    """The start record of an attempt, reconstructed from its end."""
    host = end.host.name if end.host else ""
    return AttemptStart(attempt=end.attempt, shard=end.shard, started=end.started, host=host)


def start_key(attempt: str) -> str:
    """Key of the start record of an attempt."""
    return f"ledger/{attempt}.start.json"


def end_key(attempt: str) -> str:
    """Key of the end record of an attempt."""
    return f"ledger/{attempt}.json"

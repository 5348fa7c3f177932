"""JSON records of a run as files, their keys, and the ledger: start, outcome and cost of every attempt.

Records are indented, hold their own digest, and are validated when read. Those at a run's root are written
once, with a second copy.
"""

from __future__ import annotations

import json
import platform
import re
import secrets
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from datetime import UTC, datetime
from hashlib import sha256
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from datagen.schemas.errors import InputError
from datagen.schemas.run_records import FORMAT_VERSION, AttemptStart, Commit, LedgerEntry, Manifest
from datagen.schemas.storage import Storage
from datagen.schemas.storage.errors import NotARegularFile

# The record of merged runs, which names the parts.
MERGED = "merged.json"
# The folder of files that a repair has set aside.
SET_ASIDE = "set-aside"
MAX_RECORD_BYTES = 16 * 2**20
REPAIR = "Repair it with `datagen verify --repair`"
_FIX = f"{REPAIR}, or restore the file from a copy"
# The last line of a record: the sha256 of every byte before it. The rest is JSON without its closing brace.
_TRAILER = re.compile(rb',\n "sha256": "([0-9a-f]{64})"\n}\n\Z')
_TRAILER_BYTES = len(b',\n "sha256": ""\n}\n') + 64

Record = TypeVar("Record", bound=BaseModel)


def object_key(attempt: str) -> str:
    """Key of the rows that an attempt made."""
    return f"shards/{attempt}.zip"


def commit_key(shard: int) -> str:
    """Key of a shard's commit record."""
    return f"commits/{shard:06d}.json"


def utc_now() -> str:
    """The present time in UTC, ISO 8601 with milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def encode_record(record: BaseModel) -> bytes:
    """The record as indented JSON whose last key is the sha256 of all bytes before it."""
    return signed_json(record.model_dump(mode="json"))


def signed_json(fields: Mapping[str, Any]) -> bytes:
    """The bytes of a record from its fields, as `encode_record` writes them."""
    text = json.dumps(fields, indent=1, allow_nan=False)
    if "\\ud" in text:  # lone surrogates, from file names or host names, are invalid JSON
        text = json.dumps(fields, indent=1, ensure_ascii=False).encode(errors="replace").decode()
        text = json.dumps(json.loads(text), indent=1)
    body = text.encode().removesuffix(b"\n}")
    return body + b',\n "sha256": "' + sha256(body).hexdigest().encode() + b'"\n}\n'


def decode_record(place: str, data: bytes, model: type[Record]) -> Record:
    """Return the validated record of a file at `place`.

    InputError where its bytes were changed, where it is not JSON, and for unknown or missing fields and
    values out of range.
    """
    trailer = _TRAILER.search(data, max(0, len(data) - _TRAILER_BYTES))
    if trailer is None:
        raise InputError(place, "sha256", "is missing at the end: the record is incomplete", _FIX)
    body = data[: trailer.start()]
    if sha256(body).hexdigest().encode() != trailer[1]:
        raise InputError(place, "sha256", "does not match: the file is damaged or was edited", _FIX)
    try:
        return model.model_validate_json(body + b"\n}")
    except ValidationError as e:
        first = e.errors(include_url=False, include_context=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        given = repr(first.get("input"))[:60]
        problem = f"{first['msg']} (it is {given})" if where else first["msg"]
        raise InputError(place, where, problem, _FIX) from e


def read_record(storage: Storage, key: str, model: type[Record]) -> Record | None:
    """Read the validated record, or None when there is no such file. InputError as `decode_record`."""
    data = storage.get(key, MAX_RECORD_BYTES)
    return None if data is None else decode_record(f"{storage.url}/{key}", data, model)


def read_records(storage: Storage, keys: Iterable[str], model: type[Record]) -> Iterator[Record]:
    """Read the records that exist, in the order of their keys. InputError as `decode_record`."""
    for key, data in storage.get_many(keys, MAX_RECORD_BYTES):
        if data is not None:
            yield decode_record(f"{storage.url}/{key}", data, model)


def different_fields(ours: object, theirs: object, path: str = "") -> list[tuple[str, object, object]]:
    """(path, ours, theirs) of every leaf that differs between two JSON values; None where one lacks it."""
    if isinstance(ours, dict) and isinstance(theirs, dict):
        rows: list[tuple[str, object, object]] = []
        for key in sorted({*ours, *theirs}, key=str):
            rows += different_fields(ours.get(key), theirs.get(key), f"{path}.{key}" if path else str(key))
        return rows
    return [] if ours == theirs else [(path, ours, theirs)]


def copy_key(key: str) -> str:
    """Key of the copy of a record at the run's root."""
    return f"copies/{key}"


def publish(storage: Storage, key: str, record: bytes) -> None:
    """Write a record at the run's root once: its copy first, then the record with the copy's bytes.

    The copy decides races, so that both are equal; after a kill in between, the next call completes it.
    """
    is_first = storage.put_new(copy_key(key), record)
    kept = None if is_first else storage.get(copy_key(key), MAX_RECORD_BYTES)
    storage.put_new(key, record if kept is None else kept)


def refuse_other_format(place: str, version: int) -> None:
    """Raise InputError for a record of another format, at `place`."""
    if version != FORMAT_VERSION:
        problem = f"is {version}, but this program reads {FORMAT_VERSION}"
        raise InputError(place, "format_version", problem, "Use the version of datagen that made the run")


def refuse_foreign(storage: Storage, *also: str) -> None:
    """Raise InputError for a folder with other files than a run's; `also` are further allowed prefixes."""
    folders = ("plans/", "copies/", "shards/", "commits/", "ledger/", ".probe-")
    ours = ("manifest.json", *folders, *also)
    problem, fix = "holds other files than those of a run", "Choose a new --out"
    try:
        for file in storage.list(""):
            if not file.key.startswith(ours):
                raise InputError(storage.url, file.key, problem, fix)
    except NotARegularFile as e:
        raise InputError(e.place, "", problem, fix) from e


def refuse_other(place: str, stored: Manifest, given: Manifest) -> None:
    """Raise InputError for a run of another specification, with every field that differs."""
    where, each = f"{place}/manifest.json", stored.layout.candidates_per_scene
    if each != given.layout.candidates_per_scene:
        problem = f"is {each}, not {given.layout.candidates_per_scene}"
        raise InputError(where, "layout.candidates_per_scene", problem, "Choose another --out")
    ours, theirs = ({**m.spec.document(), "schema_name": m.schema_name} for m in (given, stored))
    rows = different_fields(ours, theirs)
    if rows:
        shown = [f"{path}: {b!r}, but {a!r} was given" for path, a, b in rows[:20]]
        more = f"; and {len(rows) - 20} more" if len(rows) > 20 else ""
        problem = "has another specification (" + "; ".join(shown) + more + ")"
        raise InputError(where, "", problem, "Choose another --out, or give the same options")


MAX_STACK_CHARS = 20_000
_LOST_CAUSE = "it left no record, and its shard was decided without it"


class Ledger:
    """The start of every attempt, and the end of those that did not commit, under `ledger/` of a run.

    A commit is the end of its attempt: it has outcome, cost and machine. `check` raises InputError where
    nothing may be written.
    """

    def __init__(self, storage: Storage, check: Callable[[], None] = lambda: None) -> None:
        self._storage, self._check = storage, check

    def start(self, attempt: str, shard: int) -> None:
        """Record that an attempt begins. InputError for two attempts of one name, which is a defect."""
        self._check()
        record = AttemptStart(
            attempt=attempt, shard=shard, started=utc_now(), host=platform.node(), writer=secrets.token_hex(8)
        )
        if not self._storage.put_new(start_key(attempt), encode_record(record)):
            place = f"{self._storage.url}/{start_key(attempt)}"
            raise InputError(place, "", "exists already", "Give every attempt its own name")

    def end(self, entry: LedgerEntry) -> bool:
        """Record how an attempt ended without a commit; False when that was recorded. Long stacks are cut.

        The end of an attempt that another job recorded as lost replaces that guess. Where the start record is
        missing, it is written here, so that every end has one.
        """
        self._check()
        if entry.outcome != "superseded" and not self._storage.exists(start_key(entry.attempt)):
            self._storage.put_new(start_key(entry.attempt), encode_record(start_from_end(entry)))
        kept = entry.model_copy(
            update={"stack": entry.stack[-MAX_STACK_CHARS:], "cause": entry.cause[:MAX_STACK_CHARS]}
        )
        key = end_key(entry.attempt)
        if self._storage.put_new(key, encode_record(kept)):
            return True
        noted = self.end_of(entry.attempt)
        if kept.cost is None or noted is None or not is_guess(noted):
            return False
        self._storage.put(key, encode_record(kept))
        return True

    def start_of(self, attempt: str) -> AttemptStart | None:
        return read_record(self._storage, start_key(attempt), AttemptStart)

    def end_of(self, attempt: str) -> LedgerEntry | None:
        """The end record of an attempt; None while it has not ended."""
        return read_record(self._storage, end_key(attempt), LedgerEntry)

    def ends(self) -> Iterator[LedgerEntry]:
        names = sorted(name for name in self._names() if not name.endswith(".start"))
        return read_records(self._storage, map(end_key, names), LedgerEntry)

    def unfinished(self, committed: Container[str]) -> list[AttemptStart]:
        """Start records of attempts without an end, and not among the committed: running, or lost."""
        names = self._names()
        began = (name.removesuffix(".start") for name in names if name.endswith(".start"))
        open_ = sorted(attempt for attempt in began if attempt not in names and attempt not in committed)
        return list(read_records(self._storage, map(start_key, open_), AttemptStart))

    def _names(self) -> set[str]:
        """Names of all records, by listing; those of starts end in `.start`."""
        return {
            file.key[len("ledger/") : -len(".json")]
            for file in self._storage.list("ledger")
            if file.key.endswith(".json")
        }


def is_guess(end: LedgerEntry) -> bool:
    """Whether it is one of `lost_end`: the attempt may know better, and may even have committed."""
    return end.outcome == "lost" and end.cost is None


def lost_end(start: AttemptStart, ended: str) -> LedgerEntry:
    """The end record of an attempt that left none, with unknown cost.

    It is a guess, made once the shard is decided: the attempt, if still running, may replace it.
    """
    named = {name: getattr(start, name) for name in ("attempt", "shard", "started")}
    return LedgerEntry(outcome="lost", cause=_LOST_CAUSE, ended=ended, **named)


def superseded_end(commit: Commit, cause: str, started: str = "") -> LedgerEntry:
    """The end record of an attempt whose commit does not count any more, with the commit's cost."""
    kept = {name: getattr(commit, name) for name in ("attempt", "shard", "cost", "host")}
    return LedgerEntry(outcome="superseded", cause=cause, started=started, ended=commit.created, **kept)


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

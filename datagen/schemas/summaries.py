"""Summaries of a run's final records, many in one file, so that few files are read.

`index/<digest>.json.gz` is a cache. A summary is used only while its record has the change stamp for which
it was made; new or changed records are read themselves, and removed ones are dropped. Results depend only
on the records: the index may be removed at any time. (`verify` does not use it, since bytes may change
without the stamp.)
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cached_property, partial
from hashlib import sha256
from itertools import chain, islice
from typing import TypeVar

from pydantic import Field, ValidationError

from datagen.schemas.errors import InputError
from datagen.schemas.record_files import MAX_RECORD_BYTES, decode_record
from datagen.schemas.run import Run
from datagen.schemas.run_records import (
    AttemptName,
    AttemptStart,
    Cost,
    Host,
    LedgerEntry,
    Outcome,
    StoredRecord,
    other_value,
)

# Files of the former format have such names too: `refresh` and `verify --clean` remove them.
_FILE = re.compile(r"index/[0-9a-f]{1,16}\.json\.gz")
# Rows of a full file. Files with fewer than half of it are joined when the index grows.
ROWS_PER_FILE = 16_384
# A longer summary is not cached, so that a file unpacks to far less than the limit.
_MAX_SUMMARY_BYTES = 1500
_MAX_FILE_BYTES = 64 * 2**20


class CommitSummary(StoredRecord):
    """A commit record without its files."""

    shard: int = Field(ge=0)
    attempt: AttemptName
    scenes: int = Field(ge=0)
    samples: int = Field(ge=0)
    positives: int = Field(ge=0)
    redraws: dict[str, int]
    cost: Cost
    host: Host


class EndSummary(StoredRecord):
    """The end record of an attempt without its stack."""

    attempt: AttemptName
    shard: int = Field(ge=0)
    outcome: Outcome
    cause: str
    cost: Cost | None  # None where unknown


Summary = CommitSummary | EndSummary
Kind = TypeVar("Kind", CommitSummary, EndSummary)
# Change stamp and summary (JSON) of a record, by its key.
Rows = dict[str, tuple[str, str]]


class Summaries:
    """The summaries of one run as listed on creation: the ledger first, then the commits.

    Every attempt that the ledger calls committed therefore has its commit, also while a job runs.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._ledger = run.ledger.stamps()
        self._committed = run.commit_stamps()

    @cached_property
    def _indexed(self) -> dict[str, str]:
        """Valid cached summaries as JSON, by keys."""
        stamps = _stamps_by_key(self._ledger, self._committed)
        return {
            key: text
            for _, rows in _read_files(self._run)
            for key, (stamp, text) in rows.items()
            if stamp and stamps.get(key) == stamp
        }

    @property
    def shards(self) -> set[int]:
        return {int(name) for name in self._committed}

    def commits(self) -> Iterator[CommitSummary]:
        """Summaries of commits, in order of their shards. InputError as `Run.commit_of`."""
        keys = [f"commits/{name}.json" for name in sorted(self._committed, key=int)]
        return self._in_order(keys, CommitSummary)

    def ends(self) -> Iterator[EndSummary]:
        """Summaries of ended attempts, in order of their names. InputError as `Ledger.end_of`."""
        keys = [f"ledger/{name}.json" for name in sorted(self._ledger) if not name.endswith(".start")]
        return self._in_order(keys, EndSummary)

    def unfinished(self) -> list[AttemptStart]:
        """Start records of attempts without an end: running, or lost."""
        return self._run.ledger.unfinished(self._ledger)

    def _in_order(self, keys: Sequence[str], kind: type[Kind]) -> Iterator[Kind]:
        run, indexed = self._run, self._indexed
        absent = (key for key in keys if key not in indexed)
        read = run.storage.concurrent_map(partial(_read, run), absent)
        for key in keys:
            text = indexed.get(key)
            # A row that does not match its record's key is ignored, and the record is read.
            found = next(read) if text is None else _decode(run, key, text) or _read(run, key)
            if isinstance(found, InputError):
                raise found
            if isinstance(found, kind):  # else its record was removed since the listing
                yield found


def refresh(run: Run) -> int:
    """Update the index with the run's records; return the number of added ones.

    Unreadable records are omitted. Small files, and those with mostly stale rows, are joined, also those of
    concurrent updates, so that the index has few files and one row per record.
    """
    stamps = _stamps_by_key(run.ledger.stamps(), run.commit_stamps())
    known, kept, replaced = set[str](), Rows(), set(index_files(run))
    for file, rows in _read_files(run):
        valid = {k: row for k, row in rows.items() if stamps.get(k) == row[0] and k not in known}
        known.update(valid)
        if len(valid) < ROWS_PER_FILE // 2:
            kept.update(valid)
        else:
            replaced.discard(file)
    missing = [key for key in stamps if key not in known]
    if not missing and len(replaced) <= bool(kept):
        return 0  # the files are up to date
    read = zip(missing, run.storage.concurrent_map(partial(_read, run), missing), strict=True)
    new = ((key, (stamps[key], text)) for key, found in read if (text := _encode(run, key, found)))
    todo, written, count = chain(kept.items(), new), set[str](), -len(kept)
    while rows := dict(islice(todo, ROWS_PER_FILE)):
        written.add(_write(run, rows))
        count += len(rows)
    run.storage.delete(sorted(replaced - written))
    return count


def index_files(run: Run) -> list[str]:
    """Keys of the index's files."""
    return sorted(file.key for file in run.storage.list("index") if _FILE.fullmatch(file.key))


def unreadable_files(run: Run) -> list[str]:
    """Keys of index files that are damaged, of another run or of a former format."""
    readable = {key for key, _ in _read_files(run)}
    return [key for key in index_files(run) if key not in readable]


def _stamps_by_key(ledger: dict[str, str], committed: dict[str, str]) -> dict[str, str]:
    """Change stamps of final records, by their keys."""
    ends = {f"ledger/{name}.json": stamp for name, stamp in ledger.items() if not name.endswith(".start")}
    return ends | {f"commits/{name}.json": stamp for name, stamp in committed.items()}


def _write(run: Run, rows: Rows) -> str:
    """Write an index file, named by the digest of its bytes; return its key.

    Lines: the sha256 of the rest, format and run, and the rows, with tab-separated parts.
    """
    lines = (f"{key}\t{stamp}\t{text}" for key, (stamp, text) in rows.items())
    body = "\n".join([_first_line(run), *lines]).encode()
    packer = zlib.compressobj(1, wbits=31)
    data = packer.compress(sha256(body).hexdigest().encode() + b"\n" + body) + packer.flush()
    key = f"index/{sha256(data).hexdigest()[:16]}.json.gz"
    run.storage.put(key, data)  # without fsync: it is a cache, and another driver may have removed it already
    return key


def _read_files(run: Run) -> Iterator[tuple[str, Rows]]:
    """(key, rows) of the index's readable files, one at a time."""
    for key in index_files(run):
        # A damaged file only costs time: its records are read themselves.
        with suppress(InputError, ValueError, zlib.error):
            packed = run.storage.get(key, _MAX_FILE_BYTES) or b""
            data = zlib.decompressobj(wbits=31).decompress(packed, _MAX_FILE_BYTES)
            digest, _, body = data.partition(b"\n")
            first, *lines = body.decode().split("\n", ROWS_PER_FILE)
            if digest == sha256(body).hexdigest().encode() and first == _first_line(run):
                parts = (line.split("\t", 2) for line in lines)
                yield key, {name: (stamp, text) for name, stamp, text in parts}


def _first_line(run: Run) -> str:
    return f"summaries 2 of {run.manifest.spec_hash}"


def _encode(run: Run, key: str, found: Summary | InputError | None) -> str | None:
    """The summary as JSON; None where there is none, or JSON cannot represent it."""
    if found is None or isinstance(found, InputError):
        return None
    text = found.model_dump_json(exclude_defaults=True)
    return text if len(text.encode()) <= _MAX_SUMMARY_BYTES and _decode(run, key, text) == found else None


def _decode(run: Run, key: str, text: str) -> Summary | None:
    """The summary in a row of the index; None where it does not match the key."""
    folder, _, name = key.removesuffix(".json").partition("/")
    try:
        if folder == "ledger":
            end = EndSummary.model_validate_json(text)
            return end if end.attempt == name else None
        commit, sizes = CommitSummary.model_validate_json(text), run.layout
    except ValidationError:
        return None
    scenes, samples = sizes.scenes_per_shard, sizes.samples_per_shard
    return None if other_value(commit, shard=int(name), scenes=scenes, samples=samples) else commit


def _read(run: Run, key: str) -> Summary | InputError | None:
    """The summary from the record itself: None where it was removed, the error where it is damaged."""
    data = run.storage.get(key, MAX_RECORD_BYTES)
    folder, _, name = key.removesuffix(".json").partition("/")
    try:
        if data is None:
            return None
        if folder == "ledger":
            entry = decode_record(f"{run.storage.url}/{key}", data, LedgerEntry)
            return EndSummary.model_validate(entry, from_attributes=True)
        commit = run.decode_commit(int(name), data)
        return CommitSummary.model_validate(commit, from_attributes=True)
    except InputError as e:
        return e

"""The index of a run: heads of its settled records in a few large files, so that few small ones are read.

`index/<k>.json.gz` is a cache. A head counts only while its record still has the change stamp under which
the head was taken, as listed now; a record that is new, changed or came back is read itself, and one that
vanished is gone. So the answers are those of the records alone, whatever became of the index: it may be
removed at any time. (`verify` does not use it: what changes bytes without changing the stamp is for digests.)
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property

from schemas.errors import InputError
from schemas.heads import (
    CommitHead,
    EndHead,
    HeadTable,
    Kind,
    decode_table,
    encode_table,
    head_of_commit,
    head_of_end,
    joined,
    table_of,
)
from schemas.record_files import MAX_RECORD_BYTES, decode_record
from schemas.run import Run
from schemas.run_records import AttemptStart, LedgerEntry

_FOLDER = "index"
_FILE = re.compile(r"index/([0-9]{1,9})\.json\.gz")
AnyHead = CommitHead | EndHead
_KINDS: tuple[Kind, ...] = ("ends", "commits")
_ATTEMPT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
# Rows of a full file. One below half of it is joined with others when the index grows.
ROWS_PER_FILE = 16_384
_MAX_FILE_BYTES = 64 * 2**20


def committed_heads(run: Run) -> Iterator[CommitHead]:
    """Heads of all committed shards, in order of the shards. InputError as `Run.commit_of`."""
    return Heads(run).commits()


def closed_ends(run: Run) -> Iterator[EndHead]:
    """Heads of all attempts that ended, in order of their names. InputError as `Ledger.end_of`."""
    return Heads(run).ends()


class Heads:
    """The heads of one run as listed when this is made: the ledger first, then the commits.

    So whatever the ledger calls committed has its commit, also while a job goes on.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._ledger = run.ledger.stamps()
        self._committed = run.commit_stamps()

    @cached_property
    def _tables(self) -> list[HeadTable]:
        return [table for _, table in _read_tables(self._run)]

    @property
    def shards(self) -> set[int]:
        """Committed shards."""
        return {int(name) for name in self._committed}

    def commits(self) -> Iterator[CommitHead]:
        """Heads of commits, in order of their shards."""
        for head in self._in_order("commits", self._committed):
            if isinstance(head, CommitHead):
                yield head

    def ends(self) -> Iterator[EndHead]:
        """Heads of closed attempts, in order of their names."""
        for head in self._in_order("ends", _ends_of(self._ledger)):
            if isinstance(head, EndHead):
                yield head

    def unfinished(self) -> list[AttemptStart]:
        """Attempts that began and left no end: running elsewhere, or lost."""
        return self._run.ledger.unfinished(self._ledger)

    def _in_order(self, kind: Kind, stamps: Mapping[str, str]) -> Iterator[AnyHead]:
        indexed = _valid_rows(self._tables, kind, stamps)
        order = sorted(stamps, key=lambda name: (len(name), name) if kind == "commits" else (0, name))
        direct = _read(self._run, kind, (name for name in order if name not in indexed))
        for name in order:
            if name in indexed:
                head = _checked(self._run, *indexed[name])
                if head is None:  # a row that cannot be: its record says what is true
                    head = next(_read(self._run, kind, [name]))[1]
            else:
                head = next(direct)[1]
            if isinstance(head, InputError):
                raise head
            if head is not None:  # else its record vanished since it was listed
                yield head


def refresh(run: Run) -> int:
    """Bring the index up to date with the run's records; return how many were added.

    Records that cannot be read are left out. Small files, and those most of whose rows went stale, are
    joined to full ones, so that the index has few files and no more rows than the run has records.
    Several may do this at once: each then adds a file, and the next one joins them.
    """
    stamps: dict[Kind, dict[str, str]] = {
        "ends": _ends_of(run.ledger.stamps()),
        "commits": run.commit_stamps(),
    }
    new, spent = 0, set(unreadable_files(run))
    pending: dict[Kind, HeadTable] = {kind: table_of(kind, []) for kind in _KINDS}
    known: dict[Kind, set[str]] = {kind: set() for kind in _KINDS}
    for key, table in _read_tables(run):
        names, current = known[table.kind], stamps[table.kind]
        rows = [
            row
            for row, (name, stamp) in enumerate(zip(table.names, table.stamps, strict=True))
            if current.get(name) == stamp and name not in names
        ]
        names.update(table.names[row] for row in rows)
        if len(rows) < ROWS_PER_FILE // 2:
            spent.add(key)
            if rows:
                pending[table.kind] = _flushed(run, joined(pending[table.kind], table.take(rows)))
    for kind in _KINDS:
        missing = [name for name in stamps[kind] if name not in known[kind]]
        read: list[tuple[str, str, AnyHead]] = []
        for name, head in _read(run, kind, missing):
            if head is None or isinstance(head, InputError):
                continue
            read.append((name, stamps[kind][name], head))
            if len(read) == ROWS_PER_FILE // 4:
                table = table_of(kind, read)
                new, read = new + len(table), []
                pending[kind] = _flushed(run, joined(pending[kind], table))
        table = table_of(kind, read)
        new += len(table)
        pending[kind] = _flushed(run, joined(pending[kind], table))
    if not new and len(spent) <= sum(len(table) > 0 for table in pending.values()):
        return 0  # what is there would only be written again
    for table in pending.values():
        if len(table):
            _write(run, table)
    run.storage.delete(sorted(spent))
    return new


def index_files(run: Run) -> list[str]:
    """Keys of the index's files."""
    return sorted(file.key for file in run.storage.list(_FOLDER) if _FILE.fullmatch(file.key))


def unreadable_files(run: Run) -> list[str]:
    """Keys of files of the index that are damaged, or of another run: they hold nothing."""
    readable = {key for key, _ in _read_tables(run)}
    return [key for key in index_files(run) if key not in readable]


def _flushed(run: Run, table: HeadTable) -> HeadTable:
    """Write what fills files; return the rest."""
    while len(table) >= ROWS_PER_FILE:
        _write(run, table.take(range(ROWS_PER_FILE)))
        table = table.take(range(ROWS_PER_FILE, len(table)))
    return table


def _write(run: Run, table: HeadTable) -> None:
    data = encode_table(table, run.manifest.spec_hash)
    taken = [int(found[1]) for key in index_files(run) if (found := _FILE.fullmatch(key))]
    number = max(taken, default=0) + 1
    while not run.storage.put_new(f"{_FOLDER}/{number}.json.gz", data):
        number += 1  # another driver took it just now


def _read_tables(run: Run) -> Iterator[tuple[str, HeadTable]]:
    """(key, table) of the index's readable files, one at a time."""
    for key in index_files(run):
        try:
            data = run.storage.get(key, _MAX_FILE_BYTES)
            if data is not None:
                yield key, decode_table(f"{run.storage.url}/{key}", data, run.manifest.spec_hash)
        except (InputError, ValueError, IndexError):
            continue  # damaged or foreign: its records are read themselves


def _valid_rows(
    tables: Iterable[HeadTable], kind: Kind, stamps: Mapping[str, str]
) -> dict[str, tuple[HeadTable, int]]:
    """Where the head of each record stands that has the stamp it was taken under."""
    found: dict[str, tuple[HeadTable, int]] = {}
    for table in tables:
        if table.kind == kind:
            for row, (name, stamp) in enumerate(zip(table.names, table.stamps, strict=True)):
                if stamp and stamps.get(name) == stamp:
                    found[name] = (table, row)
    return found


def _checked(run: Run, table: HeadTable, row: int) -> AnyHead | None:
    """The head in a row, or None where it is not of the record that it stands for."""
    try:
        head = table.head(row)
    except (KeyError, ValueError, TypeError, OverflowError):
        return None
    if isinstance(head, EndHead):
        return head if head.attempt == table.names[row] else None
    if not _ATTEMPT.fullmatch(head.attempt):
        return None
    layout = run.layout
    sizes = (int(table.names[row]), layout.scenes_per_shard, layout.samples_per_shard)
    return head if (head.shard, head.scenes, head.samples) == sizes else None


def _read(run: Run, kind: Kind, names: Iterable[str]) -> Iterator[tuple[str, AnyHead | InputError | None]]:
    """Heads from the records themselves: None where one vanished, the error where it is damaged."""
    folder = "commits" if kind == "commits" else "ledger"
    keys = (f"{folder}/{name}.json" for name in names)
    for key, data in run.storage.get_many(keys, MAX_RECORD_BYTES):
        name = key.removeprefix(f"{folder}/").removesuffix(".json")
        try:
            if data is None:
                yield name, None
            elif kind == "commits":
                yield name, head_of_commit(run.decode_commit(int(name), data))
            else:
                yield name, head_of_end(decode_record(f"{run.storage.url}/{key}", data, LedgerEntry))
        except InputError as e:
            yield name, e


def _ends_of(ledger: Mapping[str, str]) -> dict[str, str]:
    return {name: stamp for name, stamp in ledger.items() if not name.endswith(".start")}

"""Heads of commits and of closed attempts: what sums need of a record, and tables of them as files.

A commit names some sixty files and their digests; a head leaves those out, and stacks and times too.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import isfinite
from typing import Literal, get_args

from schemas.record_files import compact_record, decode_record
from schemas.run_records import (
    FORMAT_VERSION,
    Commit,
    Cost,
    Digest,
    Host,
    LedgerEntry,
    Outcome,
    StoredRecord,
)

_GROUPS = ("stage_wall_s", "stage_cpu_s", "stage_gpu_s", "source_s")
_COST_FIELDS = set(Cost.model_fields)
_COSTS = ("cpu_s", "peak_rss_bytes", "written_bytes")  # a number in each row that has wall_s
_OUTCOMES: frozenset[str] = frozenset(get_args(Outcome))
# Longer causes and larger numbers stay in their records alone: a table keeps floats.
_MAX_CAUSE_CHARS = 1000
_MAX_INTEGER = 2**53
# What one table file may unpack to. A file of our own stays far below.
_MAX_TABLE_BYTES = 128 * 2**20


class LateCost:
    """The cost in a row of a table, made when it is asked for: most who look at heads do not."""

    __slots__ = ("_row", "_table")

    def __init__(self, table: HeadTable, row: int) -> None:
        self._table, self._row = table, row

    def read(self) -> Cost:
        return self._table.cost(self._row)


@dataclass(frozen=True, slots=True)
class CommitHead:
    """What a commit record says of its shard, without its files."""

    shard: int
    attempt: str
    scenes: int
    samples: int
    positives: int
    redraws: Mapping[str, int]
    paid: Cost | LateCost
    host: Host

    @property
    def cost(self) -> Cost:
        return self.paid.read() if isinstance(self.paid, LateCost) else self.paid


@dataclass(frozen=True, slots=True)
class EndHead:
    """How an attempt ended, without its stack."""

    attempt: str
    shard: int
    outcome: Outcome
    cause: str
    paid: Cost | LateCost | None

    @property
    def cost(self) -> Cost | None:
        """None where the attempt left no account of itself."""
        return self.paid.read() if isinstance(self.paid, LateCost) else self.paid


Kind = Literal["commits", "ends"]


def head_of_commit(commit: Commit) -> CommitHead:
    """The commit's head."""
    return CommitHead(
        commit.shard,
        commit.attempt,
        commit.scenes,
        commit.samples,
        commit.positives,
        commit.redraws,
        commit.cost,
        commit.host,
    )


def head_of_end(entry: LedgerEntry) -> EndHead:
    """The ledger entry's head."""
    return EndHead(entry.attempt, entry.shard, entry.outcome, entry.cause, entry.cost)


class _Words(StoredRecord):
    """A column of text: its different words, and which of them each row has."""

    words: list[str]
    rows: list[int]


class _TableFile(StoredRecord):
    format_version: int = FORMAT_VERSION
    spec_hash: Digest
    kind: Kind
    names: list[str]
    stamps: list[str]
    texts: dict[str, _Words]
    numbers: dict[str, list[float | None]]


@dataclass(frozen=True, eq=False)
class HeadTable:
    """Rows of heads by columns. A row's name is its record's file name without `.json`."""

    kind: Kind
    names: Sequence[str]
    stamps: Sequence[str]  # the change stamp that the record had when its head was taken
    texts: Mapping[str, Sequence[str]]
    numbers: Mapping[str, Sequence[float | None]]

    def __len__(self) -> int:
        return len(self.names)

    def take(self, rows: Sequence[int]) -> HeadTable:
        """Some of the rows."""
        return HeadTable(
            self.kind,
            [self.names[i] for i in rows],
            [self.stamps[i] for i in rows],
            {name: [column[i] for i in rows] for name, column in self.texts.items()},
            {name: [column[i] for i in rows] for name, column in self.numbers.items()},
        )

    def head(self, row: int) -> CommitHead | EndHead:
        """The head in a row. ValueError, KeyError or TypeError where the columns do not make one."""
        wall_s = self.numbers.get("wall_s")
        paid = LateCost(self, row) if wall_s is not None and wall_s[row] is not None else None
        attempt, shard = self.texts["attempt"][row], self._integer("shard", row)
        if self.kind == "ends":
            outcome = self.texts["outcome"][row]
            if outcome not in _OUTCOMES:
                raise ValueError(outcome)
            return EndHead(attempt, shard, outcome, self.texts["cause"][row], paid)  # type: ignore[arg-type]
        if paid is None:
            raise ValueError("a commit without its cost")
        return CommitHead(
            shard,
            attempt,
            self._integer("scenes", row),
            self._integer("samples", row),
            self._integer("positives", row),
            {name: int(count) for name, count in self._part("redraws", row).items()},
            paid,
            _host(self.texts["host"][row]),
        )

    def cost(self, row: int) -> Cost:
        """The cost in a row that has one."""
        numbers = self.numbers
        return Cost.model_construct(  # validated when its record was read
            _COST_FIELDS,
            wall_s=numbers["wall_s"][row],
            cpu_s=numbers["cpu_s"][row],
            stage_wall_s=self._part("stage_wall_s", row),
            stage_cpu_s=self._part("stage_cpu_s", row),
            stage_gpu_s=self._part("stage_gpu_s", row),
            source_s=self._part("source_s", row),
            peak_rss_bytes=self._integer("peak_rss_bytes", row),
            written_bytes=self._integer("written_bytes", row),
        )

    def _part(self, group: str, row: int) -> dict[str, float]:
        return {
            key: value for key, column in self._groups.get(group, ()) if (value := column[row]) is not None
        }

    def _integer(self, name: str, row: int) -> int:
        return int(self.numbers[name][row])  # type: ignore[arg-type] - None is the TypeError that is told

    @cached_property
    def _groups(self) -> dict[str, list[tuple[str, Sequence[float | None]]]]:
        """Columns named `group.key`, by their group."""
        groups: dict[str, list[tuple[str, Sequence[float | None]]]] = {}
        for name, column in self.numbers.items():
            group, dot, key = name.partition(".")
            if dot:
                groups.setdefault(group, []).append((key, column))
        return groups


@lru_cache(maxsize=256)
def _host(text: str) -> Host:
    return Host.model_validate_json(text)


def table_of(kind: Kind, rows: Sequence[tuple[str, str, CommitHead | EndHead]]) -> HeadTable:
    """A table of (name, stamp, head). Heads that a table cannot hold exactly are left out."""
    kept = [row for row in rows if _fits(row[2])]
    numbers: dict[str, list[float | None]] = {}
    texts: dict[str, list[str]] = {}
    for i, (_, _, head) in enumerate(kept):
        for name, value in _numbers(head).items():
            if name not in numbers:
                numbers[name] = [None] * len(kept)
            numbers[name][i] = value
        for name, text in _texts(head).items():
            texts.setdefault(name, []).append(text)
    return HeadTable(kind, [name for name, _, _ in kept], [stamp for _, stamp, _ in kept], texts, numbers)


def joined(first: HeadTable, second: HeadTable) -> HeadTable:
    """The rows of two tables of one kind."""

    def numbers(table: HeadTable, name: str) -> list[float | None]:
        return list(table.numbers.get(name, [None] * len(table)))

    names = dict.fromkeys([*first.numbers, *second.numbers])
    texts = dict.fromkeys([*first.texts, *second.texts])
    return HeadTable(
        first.kind,
        [*first.names, *second.names],
        [*first.stamps, *second.stamps],
        {name: [*first.texts.get(name, ()), *second.texts.get(name, ())] for name in texts},
        {name: numbers(first, name) + numbers(second, name) for name in names},
    )


def _fits(head: CommitHead | EndHead) -> bool:
    if isinstance(head, EndHead) and len(head.cause) > _MAX_CAUSE_CHARS:
        return False
    values = _numbers(head).values()
    return all(value <= _MAX_INTEGER if isinstance(value, int) else isfinite(value) for value in values)


def _numbers(head: CommitHead | EndHead) -> dict[str, float]:
    numbers: dict[str, float] = {"shard": head.shard}
    if isinstance(head, CommitHead):
        numbers |= {"scenes": head.scenes, "samples": head.samples, "positives": head.positives}
        numbers |= {f"redraws.{name}": count for name, count in head.redraws.items()}
    cost = head.cost
    if cost is not None:
        numbers |= {"wall_s": cost.wall_s, "cpu_s": cost.cpu_s}
        numbers |= {"peak_rss_bytes": cost.peak_rss_bytes, "written_bytes": cost.written_bytes}
        for group in _GROUPS:
            numbers |= {f"{group}.{key}": value for key, value in getattr(cost, group).items()}
    return numbers


def _texts(head: CommitHead | EndHead) -> dict[str, str]:
    if isinstance(head, CommitHead):
        return {"attempt": head.attempt, "host": head.host.model_dump_json()}
    return {"attempt": head.attempt, "outcome": head.outcome, "cause": head.cause}


def encode_table(table: HeadTable, spec_hash: str) -> bytes:
    """The table's file: a signed record, packed by gzip."""
    record = _TableFile(
        spec_hash=spec_hash,
        kind=table.kind,
        names=list(table.names),
        stamps=list(table.stamps),
        texts={name: _words(column) for name, column in table.texts.items()},
        numbers={name: list(column) for name, column in table.numbers.items()},
    )
    packer = zlib.compressobj(1, wbits=31)
    return packer.compress(compact_record(record)) + packer.flush()


def decode_table(place: str, data: bytes, spec_hash: str) -> HeadTable:
    """The table of a file at `place`.

    InputError or ValueError when it is damaged, foreign, or unpacks to more than any of ours would.
    """
    unpacker = zlib.decompressobj(wbits=31)
    try:
        text = unpacker.decompress(data, _MAX_TABLE_BYTES)
    except zlib.error as e:
        raise ValueError(str(e)) from e
    record = decode_record(place, text, _TableFile)
    if record.spec_hash != spec_hash or record.format_version != FORMAT_VERSION:
        raise ValueError("of another run")
    texts = {name: [column.words[i] for i in column.rows] for name, column in record.texts.items()}
    columns = (record.stamps, *texts.values(), *record.numbers.values())
    if any(len(column) != len(record.names) for column in columns):
        raise ValueError("columns of different lengths")
    walls = [seconds is None for seconds in record.numbers.get("wall_s", ())]
    for name in _COSTS if walls else ():
        if [number is None for number in record.numbers.get(name, ())] != walls:
            raise ValueError("parts of a cost")
    return HeadTable(record.kind, record.names, record.stamps, texts, record.numbers)


def _words(column: Sequence[str]) -> _Words:
    words = {word: i for i, word in enumerate(dict.fromkeys(column))}
    return _Words(words=list(words), rows=[words[word] for word in column])

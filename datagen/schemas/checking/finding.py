"""A finding of a check: the file, the problem and the fix; and the check of one record and its copy."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Generic, Literal, TypeVar

from pydantic import BaseModel, ConfigDict

from datagen.schemas.errors import InputError
from datagen.schemas.record_files import MAX_RECORD_BYTES, REPAIR, decode_record, signed_json
from datagen.schemas.run import Run
from datagen.schemas.storage import Storage

# record: a JSON record is damaged, missing, or differs from its copy. account: the ledger is inconsistent.
# file: a committed object is missing or has other bytes. rows: committed rows break the schema. lost: the
# commit of a sealed shard is missing. foreign: a file that no record names. sealed: data.zarr has other files
# than were written. replay: a scene made again differs. stale: data.zarr is older than its run.
Kind = Literal["record", "account", "file", "rows", "lost", "foreign", "sealed", "replay", "stale"]

BACKUP = "Restore the file from a backup"

Record = TypeVar("Record", bound=BaseModel)


@dataclass(frozen=True)
class SetAside:
    """Move the finding's shard of this run out of its records, or, without a run, the finding's file."""

    run: Run | None = None


RESEAL = "reseal"  # make data.zarr again
# Bytes: write them as the file. They come from a second copy, or follow from other records.
Cure = bytes | SetAside | Literal["reseal"]


@dataclass(frozen=True)
class Finding:
    """One problem. `key` is the file or folder, relative to the checked path."""

    key: str
    kind: Kind
    problem: str
    fix: str
    shard: int | None = None
    cure: Cure | None = None


def below(prefix: str, findings: Iterable[Finding]) -> Iterator[Finding]:
    """The findings with keys relative to the merged runs, which hold their run in the folder `prefix`."""
    return (replace(finding, key=prefix + finding.key) for finding in findings)


def folder_of(storage: Storage, place: Storage) -> str:
    """The folder of a run's storage relative to that of merged runs, with a slash; "" for the same one."""
    return f"{place.url.removeprefix(storage.url)}/".lstrip("/")


def curable(key: str, kind: Kind, problem: str, cure: Cure, shard: int | None = None) -> Finding:
    """A finding that `datagen verify --repair` fixes."""
    return Finding(key, kind, problem, REPAIR, shard, cure)


class AnyRecord(BaseModel):
    """A record of which only the signature is checked, since no data depends on it."""

    model_config = ConfigDict(extra="allow")


@dataclass(frozen=True, eq=False)
class Read(Generic[Record]):
    """One record file: its bytes, if any, and the record or its problem."""

    key: str
    data: bytes | None
    record: Record | None
    problem: str


def read(
    storage: Storage, key: str, model: type[Record], refuse: Callable[[Record], str] = lambda record: ""
) -> Read[Record]:
    """Read a record; bad content does not raise.

    `refuse` returns the problem of an otherwise valid record, or "".
    """
    try:
        data = storage.get(key, MAX_RECORD_BYTES)
    except InputError as error:
        return Read(key, None, None, error.problem)
    if data is None:
        return Read(key, None, None, "missing")
    try:
        record = decode_record(key, data, model)
    except InputError as error:
        return Read(key, data, None, f"{error.field}: {error.problem}" if error.field else error.problem)
    if not _has_form(data, record):
        return Read(key, data, None, "signed, but not in the form that datagen writes")
    problem = refuse(record)
    return Read(key, data, None if problem else record, problem)


def _has_form(data: bytes, record: BaseModel) -> bool:
    """Whether a record's bytes are those of this or an older version, which lacks newer empty keys."""
    fields = json.loads(data)
    del fields["sha256"]
    known = record.model_dump(mode="json")
    return signed_json(fields) == data and json.dumps(_filled(fields)) == json.dumps(_filled(known))


def _filled(value: Any) -> Any:
    """A JSON value without the keys of empty ones."""
    if isinstance(value, dict):
        return {key: _filled(each) for key, each in value.items() if each is not None}
    return [_filled(each) for each in value] if isinstance(value, list) else value


def compare(ours: Read[Record], copy: Read[Record], fix: str = BACKUP) -> list[Finding]:
    """Check a record and its second copy; each restores the other.

    `fix` is the fix where both are valid but differ.
    """
    if ours.record is not None and copy.record is not None:
        if ours.data == copy.data:
            return []
        return [Finding(ours.key, "record", f"differs from its copy {copy.key}", fix)]
    for bad, good in ((copy, ours), (ours, copy)):
        if good.record is not None and good.data is not None:
            return [curable(bad.key, "record", bad.problem, good.data)]
    damaged = [one for one in (ours, copy) if one.problem != "missing"]
    return [Finding(one.key, "record", f"{one.problem}, as is its copy", BACKUP) for one in damaged]


def sound(ours: Read[Record], copy: Read[Record]) -> Record | None:
    """The record from whichever of the two files is undamaged."""
    return ours.record if ours.record is not None else copy.record

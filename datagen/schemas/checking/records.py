"""Checks of JSON records: signature, schema, canonical form, and equality with their copies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from pydantic import BaseModel, ConfigDict

from datagen.schemas.checking.finding import Finding, Restore, curable
from datagen.schemas.errors import InputError
from datagen.schemas.record_files import MAX_RECORD_BYTES, decode_record, signed_json
from datagen.schemas.storage import Storage

Record = TypeVar("Record", bound=BaseModel)

BACKUP = "Restore the file from a backup"


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
    # Fields of later versions are not expected in it.
    if signed_json(record.model_dump(mode="json", exclude_unset=True)) != data:
        return Read(key, data, None, "signed, but not in the form that datagen writes")
    problem = refuse(record)
    return Read(key, data, None if problem else record, problem)


def compare(
    ours: Read[Record], copy: Read[Record], shard: int | None = None, fix: str = BACKUP
) -> list[Finding]:
    """Check a record and its second copy; each restores the other.

    `fix` is the fix where both are valid but differ.
    """
    if ours.record is not None and copy.record is not None:
        if ours.data == copy.data:
            return []
        return [Finding(ours.key, "record", f"differs from its copy {copy.key}", fix, shard)]
    if ours.record is not None and ours.data is not None:
        return [curable(copy.key, "record", copy.problem, Restore(ours.data), shard)]
    if copy.record is not None and copy.data is not None:
        return [curable(ours.key, "record", ours.problem, Restore(copy.data), shard)]
    bad = [one for one in (ours, copy) if one.problem != "missing"]
    return [Finding(one.key, "record", f"{one.problem}, as is its copy", BACKUP, shard) for one in bad]


def sound(ours: Read[Record], copy: Read[Record]) -> Record | None:
    """The record from whichever of the two files is undamaged."""
    return ours.record if ours.record is not None else copy.record

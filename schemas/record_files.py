"""The JSON records of a run as files: written readably, read back with suspicion."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from schemas.errors import InputError
from schemas.storage import Storage

MAX_RECORD_BYTES = 16 * 2**20
_MEND = "Restore the file from a copy; if there is none, remove it"

Record = TypeVar("Record", bound=BaseModel)


def now() -> str:
    """The present time in UTC, ISO 8601 with milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def encode_record(record: BaseModel) -> bytes:
    """The record as indented JSON."""
    return (json.dumps(record.model_dump(mode="json"), indent=1, allow_nan=False) + "\n").encode()


def read_record(storage: Storage, key: str, model: type[Record]) -> Record | None:
    """The validated record, or None when there is no such file.

    InputError names the file and the field when it is not JSON, has unknown or missing fields,
    values out of range, or more bytes than a record can have.
    """
    data = storage.get(key, MAX_RECORD_BYTES)
    if data is None:
        return None
    place = f"{storage.url}/{key}"
    try:
        return model.model_validate_json(data)
    except ValidationError as e:
        first = e.errors(include_url=False, include_context=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        given = repr(first.get("input"))[:60]
        problem = f"{first['msg']} (it is {given})" if where else first["msg"]
        raise InputError(place, where, problem, _MEND) from e


def different_fields(ours: object, theirs: object, path: str = "") -> list[tuple[str, object, object]]:
    """(path, ours, theirs) of every leaf in which two JSON values differ; None where one lacks it."""
    if isinstance(ours, dict) and isinstance(theirs, dict):
        rows: list[tuple[str, object, object]] = []
        for key in sorted({*ours, *theirs}, key=str):
            rows += different_fields(ours.get(key), theirs.get(key), f"{path}.{key}" if path else str(key))
        return rows
    return [] if ours == theirs else [(path, ours, theirs)]

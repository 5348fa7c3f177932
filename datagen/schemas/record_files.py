"""JSON records of a run as files: indented, with their own digest, and validated when read.

Records at a run's root are written once, with a second copy.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime
from hashlib import sha256
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from datagen.schemas.errors import InputError
from datagen.schemas.run_records import FORMAT_VERSION, Manifest
from datagen.schemas.storage import Storage
from datagen.schemas.storage.errors import NotARegularFile

MAX_RECORD_BYTES = 16 * 2**20
REPAIR = "Repair it with `datagen verify --repair`"
_FIX = f"{REPAIR}, or restore the file from a copy"
# The last line of a record: the sha256 of every byte before it. The rest is JSON without its closing brace.
_TRAILER = re.compile(rb',\n "sha256": "([0-9a-f]{64})"\n}\n\Z')
_TRAILER_BYTES = len(b',\n "sha256": ""\n}\n') + 64

Record = TypeVar("Record", bound=BaseModel)


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
    storage.put_new(copy_key(key), record)
    kept = storage.get(copy_key(key), MAX_RECORD_BYTES)
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
    ours, theirs = (
        {"spec": one.spec.model_dump(mode="json"), "schema_name": one.schema_name} for one in (given, stored)
    )
    rows = different_fields(ours, theirs)
    where, each = f"{place}/manifest.json", stored.layout.candidates_per_scene
    if each != given.layout.candidates_per_scene:
        problem = f"is {each}, not {given.layout.candidates_per_scene}"
        raise InputError(where, "layout.candidates_per_scene", problem, "Choose another --out")
    if rows:
        shown = [f"{path.removeprefix('spec.')}: {b!r}, but {a!r} was given" for path, a, b in rows[:20]]
        more = f"; and {len(rows) - 20} more" if len(rows) > 20 else ""
        problem = "has another specification (" + "; ".join(shown) + more + ")"
        raise InputError(where, "", problem, "Choose another --out, or give the same options")

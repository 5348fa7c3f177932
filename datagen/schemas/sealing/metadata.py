"""The zarr.json files of a sealed store, and the runs listed in its root."""

from __future__ import annotations

import json
import warnings
from typing import Any

import zarr
from pydantic import BaseModel, ValidationError
from zarr.core.buffer import default_buffer_prototype
from zarr.storage import MemoryStore

from datagen.schemas.description import cf_attributes, described
from datagen.schemas.fields import TABLES
from datagen.schemas.record_files import MAX_RECORD_BYTES
from datagen.schemas.sealing.contents import Contents, SealedRun
from datagen.schemas.shard_files import root_attributes, zarr_metadata
from datagen.schemas.storage import Storage

SEALED = "data.zarr"
ROOT = "zarr.json"


class SealedPart(BaseModel):
    """One run in a sealed store: the samples wanted, and the missing shards."""

    spec_hash: str
    n: int
    missing_shards: list[int]


class SealedRoot(BaseModel):
    """The content of the root zarr.json of a sealed store; one part for a single run."""

    parts: list[SealedPart]
    # sha256 over the digests of all files of its shards, in order; "" where unknown.
    rows_sha256: str = ""

    def part(self, spec_hash: str) -> SealedPart | None:
        return next((part for part in self.parts if part.spec_hash == spec_hash), None)


def sealed_root(storage: Storage) -> SealedRoot | None:
    """Read the root of data.zarr in `storage`; None where it does not exist or has another form."""
    data = storage.get(f"{SEALED}/{ROOT}", MAX_RECORD_BYTES)
    if data is None:
        return None
    try:
        attributes = json.loads(data)["attributes"]
        if "parts" not in attributes:  # a single run
            attributes = {"parts": [attributes], "rows_sha256": attributes.get("rows_sha256", "")}
        return SealedRoot.model_validate(attributes)
    except (ValueError, KeyError, TypeError, RecursionError, ValidationError):
        return None


def sealed_metadata(contents: Contents) -> dict[str, bytes]:
    """zarr.json files of the store by path; the root's has consolidated metadata."""
    first = contents.runs[0]
    attributes = root_attributes(contents.schema, contents.layout, first.run.manifest.spec_hash)
    if contents.is_merged:
        del attributes["spec_hash"]
        attributes["parts"] = [_part(run) for run in contents.runs]
    else:
        attributes |= _part(first)
    attributes["rows_sha256"] = contents.digests[-1]
    rows = {table: contents.rows(table) for table in TABLES}
    specs = [part.run.manifest.spec for part in contents.runs]
    attributes = described(specs, [part.n for part in contents.runs]) | attributes
    of_arrays = {f.name: cf_attributes(f, table) for table, f in contents.schema.fields}
    files = zarr_metadata(contents.schema, contents.layout, rows, attributes, of_arrays)
    make = default_buffer_prototype().buffer.from_bytes
    store = {path: make(data) for path, data in files.items()}
    with warnings.catch_warnings():
        # Consolidated metadata is not in the Zarr v3 specification yet; common readers support it.
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(MemoryStore(store), zarr_format=3)
    return {path: buffer.to_bytes() for path, buffer in store.items()}


def _part(sealed: SealedRun) -> dict[str, Any]:
    return {
        "spec_hash": sealed.run.manifest.spec_hash,
        "n": sealed.n,
        "shards": len(sealed.shards),
        "missing_shards": list(sealed.missing_shards),
        "specification": sealed.run.manifest.spec.document(),
    }

"""Seal: one flat Zarr v3 store over the committed shards, which stock readers open.

Chunks are hard links to the shards' files, so sealing copies nothing; metadata is new. Shards are
packed in order of their index, and rows beyond n are cut by the arrays' shape alone.
"""

from __future__ import annotations

import errno
import json
import os
import secrets
import shutil
import warnings
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import zarr
from pydantic import BaseModel
from zarr.core.buffer import default_buffer_prototype
from zarr.storage import MemoryStore

from schemas.errors import InputError
from schemas.fields import RecordSchema
from schemas.record_files import MAX_RECORD_BYTES
from schemas.run import Run, shard_folder
from schemas.run_records import Commit
from schemas.shard_files import (
    TABLES,
    chunk_key,
    chunk_rows,
    group_metadata,
    root_attributes,
    rows_per_shard,
    zarr_metadata,
)
from schemas.storage import storage_error

SEALED = "data.zarr"


def seal(run: Run) -> Path:
    """Lay RUN/data.zarr over the committed shards; shards in quarantine or undone are left out.

    An older sealed store is replaced. The new one is complete before it takes the name. Linked
    files become read-only. InputError when nothing is committed, a committed file is missing or of
    another size, or the disk refuses.
    """
    folder = run.storage.folder
    if folder is None:
        raise InputError(
            run.storage.url, "", "sealing needs a local folder", "Copy the run to a disk and seal it there"
        )
    schema = run.schema
    n = run.n  # read once: the run may grow meanwhile
    commits = [commit for commit in run.commits() if commit.shard < run.layout.shards_for(n)]
    if not commits:
        raise InputError(run.storage.url, "commits", "no shard is committed", "Submit the run again")
    for commit in commits:
        run.check_files(commit)
    expected = _files_of_a_shard(run, schema)
    for commit in commits:
        _refuse_odd_files(run, commit, expected)
    draft = folder / f"{SEALED}.{secrets.token_hex(8)}.partial"
    try:
        _write(draft, sealed_metadata(run, schema, n, [commit.shard for commit in commits]))
        _link(run, schema, n, commits, draft)
        _sync_folders(draft)
        _take_the_name(draft, folder / SEALED)
    except OSError as e:
        raise storage_error(e.filename or draft, e) from e
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    return folder / SEALED


class SealedRoot(BaseModel):
    """What the root zarr.json of a sealed store says of the run that it was laid over."""

    n: int
    missing_shards: list[int]


def sealed_root(run: Run) -> SealedRoot | None:
    """The attributes of RUN/data.zarr, or None where it does not exist or is not readable as ours."""
    data = run.storage.get(f"{SEALED}/zarr.json", MAX_RECORD_BYTES)
    if data is None:
        return None
    try:
        return SealedRoot.model_validate(json.loads(data)["attributes"])
    except (ValueError, KeyError, TypeError, RecursionError):
        return None


def sealed_metadata(run: Run, schema: RecordSchema, n: int, shards: list[int]) -> dict[str, bytes]:
    """zarr.json files of the sealed store, the root's with consolidated metadata."""
    wanted = [run.layout.rows_wanted(shard, n) for shard in shards]
    rows = {"scene": sum(scenes for scenes, _ in wanted), "sample": sum(samples for _, samples in wanted)}
    absent = sorted(set(range(run.layout.shards_for(n))) - set(shards))
    attributes: dict[str, Any] = {
        **root_attributes(schema, run.layout, run.manifest.spec_hash),
        "n": n,
        "missing_shards": absent,
        "specification": run.manifest.spec.model_dump(mode="json"),
    }
    files = zarr_metadata(schema, run.layout, rows, attributes)
    make = default_buffer_prototype().buffer.from_bytes
    store = {path: make(data) for path, data in files.items()}
    with warnings.catch_warnings():
        # Consolidated metadata is not yet in the Zarr v3 text; every reader we name knows it.
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(MemoryStore(store), zarr_format=3)
    return {path: buffer.to_bytes() for path, buffer in store.items()}


def _files_of_a_shard(run: Run, schema: RecordSchema) -> frozenset[str]:
    files = set(group_metadata(schema, run.layout, run.manifest.spec_hash))
    for table in TABLES:
        rows = rows_per_shard(run.layout, table)
        for field in schema.table(table):
            count = rows // chunk_rows(schema, field, rows)
            files |= {f"{field.name}/{chunk_key(field, i)}" for i in range(count)}
    return frozenset(files)


def _refuse_odd_files(run: Run, commit: Commit, expected: frozenset[str]) -> None:
    odd = sorted(expected ^ {entry.path for entry in commit.files})
    if odd:
        raise InputError(
            f"{run.storage.url}/{shard_folder(commit.shard, commit.attempt)}",
            "files",
            f"the commit lacks or adds {len(odd)} files, first {odd[0]}",
            "Remove this shard's commit and submit the run again",
        )


def _write(draft: Path, files: Mapping[str, bytes]) -> None:
    for path, data in files.items():
        target = draft / path
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("xb") as f:
            f.write(data)
            f.flush()
            os.fsync(f.fileno())


def _link(run: Run, schema: RecordSchema, n: int, commits: Iterable[Commit], draft: Path) -> None:
    for position, commit in enumerate(commits):
        source = shard_folder(commit.shard, commit.attempt)
        scenes, samples = run.layout.rows_wanted(commit.shard, n)
        for table, wanted in zip(TABLES, (scenes, samples), strict=True):
            rows = rows_per_shard(run.layout, table)
            for field in schema.table(table):
                step = chunk_rows(schema, field, rows)
                first = position * (rows // step)
                for i in range(-(-wanted // step)):
                    key = f"{source}/{field.name}/{chunk_key(field, i)}"
                    target = f"{draft.name}/{field.name}/{chunk_key(field, first + i)}"
                    run.storage.link_or_copy(key, target)
                    (draft.parent / target).chmod(0o444)


def _sync_folders(draft: Path) -> None:
    for path in (*(p for p in draft.iterdir() if p.is_dir()), draft):
        fd = os.open(path, os.O_RDONLY)
        try:
            os.fsync(fd)
        finally:
            os.close(fd)


def _take_the_name(draft: Path, sealed: Path) -> None:
    """Give the finished store its name; an older one steps aside first and is then removed."""
    old = sealed.with_name(f"{draft.name}.old")
    named = False
    while not named:
        with suppress(FileNotFoundError):
            sealed.rename(old)
        try:
            draft.rename(sealed)
            named = True
        except OSError as e:
            # Two jobs of one run end together: the other's store took the name just now.
            if e.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
        shutil.rmtree(old, ignore_errors=True)
    fd = os.open(sealed.parent, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)

"""export.json: which files an export has, and the run that they were made from."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from hashlib import sha256
from pathlib import Path

from pydantic import Field

from datagen.schemas.errors import InputError
from datagen.schemas.record_files import encode_record, read_record
from datagen.schemas.run import Run, open_runs
from datagen.schemas.run_records import MAX_FILE_BYTES, Digest, FileEntry, StoredRecord
from datagen.schemas.storage import Storage

EXPORT = "export.json"
_AGAIN, _SAME = "Export again into a new --out", "Run the same `datagen export` again"


class ExportedFile(FileEntry):
    """A file of an export. `step` made it; `counts` are for later steps, as its rows."""

    step: int = Field(ge=0)
    counts: dict[str, int] = Field(default_factory=dict)


class ExportRecord(StoredRecord):
    """export.json, rewritten as steps are done; equal runs and options give equal bytes."""

    format: str
    version: str  # of datagen
    run: str  # address; of a folder the path from the export's folder, where that is a folder too
    run_sha256: Digest
    spec_hashes: tuple[Digest, ...]
    scenes: tuple[int, int]  # first, and one past the last
    license: str
    acknowledgement: str
    complete: bool = False
    files: tuple[ExportedFile, ...] = ()

    def write(self, storage: Storage) -> None:
        """Write the record into the export's folder, or replace it."""
        storage.put(EXPORT, encode_record(self))


def run_digest(runs: Sequence[Run]) -> str:
    """sha256 over the specification and the labels of runs: digests of the shards, and which rows count."""
    digest = sha256()
    for run in runs:
        n = run.n
        planned = run.planned(n)
        digest.update(run.manifest.spec_hash.encode())
        for commit in run.brief_commits():
            if commit.shard in planned:
                rows = tuple(run.rows_of(commit.shard, n))
                digest.update(f"\n{commit.shard} {rows} {commit.object.sha256}".encode())
    return digest.hexdigest()


def is_intact(storage: Storage, file: FileEntry) -> bool:
    """Whether an exported file has its recorded bytes."""
    data = storage.get(file.path, MAX_FILE_BYTES)
    return data is not None and sha256(data).hexdigest() == file.sha256


def read_export(storage: Storage) -> ExportRecord | None:
    """The record of the export in a folder; None where it has none. InputError where it is damaged."""
    try:
        return read_record(storage, EXPORT, ExportRecord)
    except InputError as error:
        raise InputError(error.place, error.field, error.problem, _AGAIN) from None


def check_export(storage: Storage, record: ExportRecord) -> Iterator[tuple[str, str]]:
    """Yield (file, problem) for each difference of an export from its record or from its run.

    InputError where the run is not at its address.
    """
    if not record.complete:
        yield EXPORT, f"the export was interrupted. {_SAME}"
    for file in record.files:
        if not is_intact(storage, file):
            yield file.path, f"is missing or was changed. {_SAME}"
    named = {EXPORT, *(file.path for file in record.files)}
    for stored in storage.list(""):
        if stored.key not in named:
            yield stored.key, "is not of this export. Move it away"
    if run_digest(open_runs(run_address(storage, record))) != record.run_sha256:
        yield EXPORT, f"the run has changed since. {_AGAIN}"


def run_address(storage: Storage, record: ExportRecord) -> str:
    """The address of an export's run. InputError where it has none any more."""
    if storage.folder is None or "://" in record.run:
        return record.run
    path = os.path.normpath(storage.folder / record.run)
    if not Path(path).is_dir():
        fix = f"Move the run there. Or {_AGAIN.lower()}"
        raise InputError(f"{storage.url}/{EXPORT}", "run", f"{path}: no such folder", fix)
    return path


def refuse_other_export(storage: Storage, found: ExportRecord, wanted: ExportRecord) -> None:
    """Raise InputError where a folder's export has another format, run or version."""
    for name in ("format", "version", "run_sha256", "scenes"):
        ours, theirs = getattr(wanted, name), getattr(found, name)
        if ours != theirs:
            problem = f"holds an export with another {name}: {theirs}, not {ours}"
            raise InputError(storage.url, EXPORT, problem, "Give a new --out")

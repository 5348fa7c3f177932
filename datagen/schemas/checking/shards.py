"""Checks of the files of a committed shard, and of the rows in them."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from hashlib import sha256
from typing import Any

import numpy as np

from datagen.schemas.checking.finding import Finding, SetAside, curable
from datagen.schemas.errors import InputError
from datagen.schemas.fields import Field, RecordSchema, Table
from datagen.schemas.identity import sample_ids
from datagen.schemas.outcomes import REDRAW_CAUSES
from datagen.schemas.record_files import commit_key, shard_folder
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit, FileEntry
from datagen.schemas.shard_files import MAX_TEXT_BYTES, chunk_paths, group_metadata, rows_per_shard
from datagen.schemas.shard_reading import MAX_META_BYTES, Array, StoredArray, decode_chunk, parse_metadata
from datagen.schemas.storage import StoredFile

# Arrays that are checked together; every other array is checked by itself.
_KEYS = ("scene_index", "redraws", "sample_id", "sample_scene_index", "candidate_index", "label")


@dataclass(frozen=True, eq=False)
class ShardForm:
    """The required form of every shard of a run."""

    schema: RecordSchema
    metadata: Mapping[str, bytes]
    chunks: Mapping[str, tuple[str, ...]]  # paths of each array's chunks, in order of rows
    arrays: Mapping[str, StoredArray]

    def most_bytes(self, path: str) -> int:
        array = self.arrays.get(path.split("/")[0])
        if array is None or path in self.metadata:
            return MAX_META_BYTES
        count = array.chunk_rows * math.prod(array.shape[1:])
        item = 4 + MAX_TEXT_BYTES if array.is_text else np.dtype(array.dtype).itemsize
        return 2**10 + count * item * 17 // 16  # zstd adds less than 1 % to incompressible data

    @property
    def paths(self) -> frozenset[str]:
        return frozenset((*self.metadata, *(path for paths in self.chunks.values() for path in paths)))


def form_of(run: Run) -> ShardForm:
    """The required form of this run's shards."""
    schema, layout = run.schema, run.layout
    metadata = group_metadata(schema, layout, run.manifest.spec_hash)
    chunks = {f.name: chunk_paths(schema, layout, table, f) for table, f in schema.fields}
    paths = {name: f"{name}/zarr.json" for name in chunks}
    arrays = {name: parse_metadata(path, name, metadata[path]) for name, path in paths.items()}
    return ShardForm(schema, metadata, chunks, arrays)


def check_shard(run: Run, form: ShardForm, commit: Commit, listed: Mapping[str, StoredFile]) -> list[Finding]:
    """Check every file of a committed shard against its entry, and the rows against the schema.

    `listed` are the files below the attempt's folder; drafts of killed writers (.part) are garbage.
    Holds at most one shard's arrays in memory.
    """
    folder, shard = shard_folder(commit.shard, commit.attempt), commit.shard
    entries = {entry.path: entry for entry in commit.files}
    findings: list[Finding] = []

    def wrong(key: str, problem: str) -> None:
        """Rows or files that are as committed, but not those of this shard."""
        findings.append(curable(key, "rows", problem, SetAside(run), shard))

    if odd := sorted(form.paths ^ entries.keys()):
        problem = f"files: {len(odd)} missing or extra, first {odd[0]}"
        wrong(commit_key(shard), problem)
    known = {f"{folder}/{path}" for path in ("commit.json", *entries)}
    for key in listed:
        if key not in known and not key.endswith(".part"):
            problem = "is in a committed attempt's folder, but in no record"
            findings.append(curable(key, "foreign", problem, SetAside(), shard))

    def read(paths: Iterable[str]) -> dict[str, bytes]:
        """The bytes of committed files; missing and changed ones become findings."""
        found: dict[str, bytes] = {}
        for path in paths:
            if path in entries:
                data, finding = _bytes_of(run, form, commit, entries[path], listed.get(f"{folder}/{path}"))
                findings.extend([finding] if finding else [])
                found |= {} if data is None else {path: data}
        return found

    for path, data in read(form.metadata).items():
        if not same_json(data, form.metadata[path]):
            wrong(f"{folder}/{path}", "differs from the metadata of the schema")
    kept: dict[str, Array] = {}
    whole = True
    for table, field in form.schema.fields:
        paths = form.chunks[field.name]
        chunks = read(paths)
        values, problem = None, ""
        if len(chunks) == len(paths):
            values, problem = _decode(run, form, table, field, list(chunks.values()))
        if problem:
            wrong(f"{folder}/{field.name}", problem)
        if values is None:
            whole = False
        elif field.name in _KEYS:
            kept[field.name] = values
    if whole:
        for name, problem in _row_problems(run, commit, kept):
            wrong(f"{folder}/{name}", problem)
    return findings


def _bytes_of(
    run: Run, form: ShardForm, commit: Commit, entry: FileEntry, there: StoredFile | None
) -> tuple[bytes | None, Finding | None]:
    """A file's bytes where they are the committed ones, or the finding."""
    key = f"{shard_folder(commit.shard, commit.attempt)}/{entry.path}"
    if entry.size > form.most_bytes(entry.path):
        problem = f"has {entry.size} bytes by its commit, more than such a file can have"
        return None, curable(key, "rows", problem, SetAside(run), commit.shard)
    data, problem = None, "missing"
    if there is not None and there.size != entry.size:
        problem = f"has {there.size} bytes, but {entry.size} were committed"
    elif there is not None:
        try:
            data = run.storage.get(key, entry.size)
        except InputError as error:
            problem = error.problem
    if data is not None:
        if sha256(data).hexdigest() == entry.sha256:
            return data, None
        problem = "sha256: differs from the committed bytes"
    return None, curable(key, "file", problem, SetAside(run), commit.shard)


def same_json(data: bytes, wanted: bytes) -> bool:
    """Whether two files are equal, up to the layout of JSON."""
    if data == wanted:
        return True
    try:
        return bool(json.loads(data) == json.loads(wanted))
    except (ValueError, RecursionError):
        return False


def _decode(
    run: Run, form: ShardForm, table: Table, field: Field, chunks: list[bytes]
) -> tuple[Array | None, str]:
    """An array of the shard, checked for dtype, shape and range; or the problem."""
    rows = rows_per_shard(run.layout, table)
    alone = replace(form.schema, scene_fields=(field,), sample_fields=(field,))
    try:
        parts = [decode_chunk(field.name, form.arrays[field.name], data) for data in chunks]
        values = parts[0] if len(parts) == 1 else np.concatenate(parts)
        alone.check(table, rows, {field.name: values})
    except InputError as error:
        return None, error.problem
    return values, ""


def _row_problems(run: Run, commit: Commit, kept: Mapping[str, Array]) -> Iterator[tuple[str, str]]:
    """Yield (array, problem) where rows are not those of this shard, or differ from its commit."""
    first = commit.shard * run.layout.scenes_per_shard
    scenes = np.arange(first, first + commit.scenes)
    candidates = np.arange(run.layout.candidates_per_scene, dtype=np.int32)
    wanted: dict[str, np.ndarray[Any, Any]] = {
        "scene_index": scenes,
        "sample_scene_index": np.repeat(scenes, len(candidates)),
        "candidate_index": np.tile(candidates, len(scenes)),
        "sample_id": np.concatenate(
            [sample_ids(run.manifest.spec_hash, int(scene), candidates) for scene in scenes]
        ),
    }
    for name, values in wanted.items():
        if not np.array_equal(kept[name], values):
            row = int(np.flatnonzero((kept[name] != values).reshape(len(values), -1).any(axis=1))[0])
            yield name, f"row {row} does not belong at its position in the run"
    positives = int(np.count_nonzero(kept["label"]))
    if positives != commit.positives:
        yield "label", f"has {positives} positives, but the commit has {commit.positives}"
    sums = dict(zip(REDRAW_CAUSES, kept["redraws"].sum(axis=0).tolist(), strict=False))
    redraws = {cause: count for cause, count in sums.items() if count}
    # Scenes of --scenes-from keep the counts of the run that made them.
    known = [redraws] if run.manifest.spec.scenes_from is None else [redraws, {}]
    if {cause: count for cause, count in commit.redraws.items() if count} not in known:
        yield "redraws", f"sum to {redraws}, but the commit has {commit.redraws}"

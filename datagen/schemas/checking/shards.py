"""Checks of the object of a committed shard, and of the rows in it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from datagen.schemas.checking.finding import Finding, SetAside, curable
from datagen.schemas.errors import InputError
from datagen.schemas.fields import Field, Table
from datagen.schemas.identity import sample_ids
from datagen.schemas.outcomes import REDRAW_CAUSES
from datagen.schemas.record_files import object_key
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit
from datagen.schemas.shard_files import chunk_paths, group_metadata, rows_per_shard
from datagen.schemas.shard_reading import ZipFiles
from datagen.schemas.stored_arrays import Array, StoredArray, arrays_of, decode_chunk

# Arrays that are checked together; every other array is checked by itself.
_KEYS = ("scene_index", "redraws", "sample_id", "sample_scene_index", "candidate_index", "label")


def check_shard(run: Run, commit: Commit) -> list[Finding]:
    """Check the object of a committed shard against its commit, and the rows against the schema.

    Holds at most one shard's arrays in memory.
    """
    key, shard = object_key(commit.attempt), commit.shard
    schema, layout = run.schema, run.layout
    findings: list[Finding] = []

    def wrong(name: str, problem: str) -> None:
        """Rows that are as committed, but not those of this shard."""
        findings.append(curable(f"{key}/{name}", "rows", problem, SetAside(run), shard))

    try:
        data = run.read_object(commit)
    except InputError as error:
        return [curable(key, "file", error.problem, SetAside(run), shard)]
    metadata = group_metadata(schema, layout, run.manifest.spec_hash)
    chunks = {field.name: chunk_paths(schema, layout, table, field) for table, field in schema.fields}
    kept: dict[str, Array] = {}
    try:
        files = ZipFiles(key, data)
        expected = [*metadata, *(path for paths in chunks.values() for path in paths)]
        if sorted(files.paths) != sorted(expected):
            odd = sorted({*files.paths} ^ {*expected}) or ["a second file of one name"]
            wrong("", f"{len(odd)} files are missing or extra, first {odd[0]}")
            return findings
        for path, wanted in metadata.items():
            if not same_json(files.get(path), wanted):
                wrong(path, "differs from the metadata of the schema")
        arrays = arrays_of(schema, layout)
        for table, field in schema.fields:
            found = [files.get(path) for path in chunks[field.name]]
            values, problem = _decode(run, arrays[field.name], table, field, found)
            if problem:
                wrong(field.name, problem)
            elif field.name in _KEYS and values is not None:
                kept[field.name] = values
    except InputError as error:
        wrong("", error.problem)
    if not findings:
        for name, problem in _row_problems(run, commit, kept):
            wrong(name, problem)
    return findings


def same_json(data: bytes, wanted: bytes) -> bool:
    """Whether two files are equal, up to the layout of JSON."""
    with suppress(ValueError, RecursionError):
        return data == wanted or bool(json.loads(data) == json.loads(wanted))
    return False


def _decode(
    run: Run, array: StoredArray, table: Table, field: Field, chunks: list[bytes]
) -> tuple[Array | None, str]:
    """An array of the shard, checked for dtype, shape and range; or the problem."""
    alone = replace(run.schema, scene_fields=(field,), sample_fields=(field,))
    try:
        values = np.concatenate([decode_chunk(field.name, array, data) for data in chunks])
        alone.check(table, rows_per_shard(run.layout, table), {field.name: values})
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

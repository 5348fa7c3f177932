"""Check a run, or merged runs, one shard at a time: commits, objects and rows, and the sealed store."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from hashlib import sha256
from itertools import chain
from typing import Any

import numpy as np

from datagen.schemas.checking.finding import RESEAL, Finding, SetAside, below, curable, folder_of, read
from datagen.schemas.checking.records import (
    LedgerTotals,
    check_ledger,
    check_notes,
    check_plans,
    check_quarantine,
    open_roots,
)
from datagen.schemas.errors import InputError
from datagen.schemas.fields import REDRAW_CAUSES, Field, Table
from datagen.schemas.identity import sample_ids
from datagen.schemas.record_files import commit_key, object_key
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit, SealedPart, StoreRecord, foreign_field
from datagen.schemas.sealing import RECORD, claimed_names, read_contents, store_record
from datagen.schemas.shard_files import chunk_paths, group_metadata, rows_per_shard
from datagen.schemas.shard_ranges import ShardRanges
from datagen.schemas.shard_reading import ZipFiles
from datagen.schemas.storage import Storage, concurrent_map
from datagen.schemas.stored_arrays import Array, StoredArray, arrays_of, decode_chunk

_THREADS = 4  # hashing and decompression release the GIL
_REMOTE_THREADS = 16  # requests mostly wait for the server


@dataclass
class Checked:
    """Counts of what was checked, for the report; they grow while findings are consumed."""

    shards: int = 0
    bytes: int = 0
    samples: int = 0
    is_sealed: bool = False
    totals: LedgerTotals = field(default_factory=LedgerTotals)
    runs: list[Run] = field(default_factory=list[Run])
    of_other_code: int = 0  # shards by other code than began their run

    def count(self, commit: Commit) -> None:
        self.shards += 1
        self.bytes += commit.object.size
        self.samples += commit.samples
        self.totals.attempts += 1
        self.totals.committed_wall_s += commit.cost.wall_s


def check_runs(
    storage: Storage, checked: Checked, seen: Callable[[int, int], None] = lambda done, total: None
) -> Iterator[Finding]:
    """Yield every problem in `storage`, as it is found.

    `checked` is filled meanwhile; `seen(done, total)` is called for shards. Every file is read once.
    InputError where there is no run, or one of another format or schema.
    """
    checked.runs, found = open_roots(storage)
    for run in checked.runs:
        found += below(folder_of(storage, run.storage), check_plans(run))
    for place in ({run.storage.url: run.storage for run in checked.runs} | {storage.url: storage}).values():
        found += below(folder_of(storage, place), check_notes(place))
    yield from found
    record, of_store = _read_store(storage)
    yield from of_store
    checked.is_sealed = record is not None
    work = [(run, sorted(run.committed())) for run in checked.runs]
    total, done, is_sound = sum(len(shards) for _, shards in work), 0, not found
    threads = _REMOTE_THREADS if storage.folder is None else _THREADS
    with ThreadPoolExecutor(threads) as pool:
        for run, shards in work:
            prefix, committed = folder_of(storage, run.storage), dict[int, str]()
            for shard, commit, findings in concurrent_map(pool, 2 * threads, partial(_look_at, run), shards):
                yield from below(prefix, findings)
                is_sound = is_sound and not findings
                if commit is not None:
                    committed[shard] = commit.attempt
                    checked.count(commit)
                    checked.of_other_code += commit.code_digest != run.manifest.code_digest
                done += 1
                seen(done, total)
            rest = (_check_objects(run), check_ledger(run, committed, checked.totals), check_quarantine(run))
            yield from below(prefix, chain.from_iterable(rest))
    if record is not None:
        yield from _check_store(storage, record, checked.runs, is_sound)


def _look_at(run: Run, shard: int) -> tuple[int, Commit | None, list[Finding]]:
    """Check one shard: commit, object, rows. A damaged commit is set aside, and the shard made again."""
    found = read(
        run.storage,
        commit_key(shard),
        Commit,
        lambda commit: ": ".join(foreign_field(run.manifest, shard, commit) or ()),
    )
    if found.record is None:
        return shard, None, [curable(found.key, "record", found.problem, SetAside(run), shard)]
    return shard, found.record, _check_shard(run, found.record)


def _check_objects(run: Run) -> Iterator[Finding]:
    """Other files among the objects; those of attempts that did not commit are garbage, not damage."""
    for file in run.storage.list("shards"):
        name = file.key.removeprefix("shards/")
        if "/" in name or not (name.endswith(".part") or file.key == object_key(name.removesuffix(".zip"))):
            yield curable(file.key, "foreign", "is not the object of an attempt", SetAside())


def _read_store(storage: Storage) -> tuple[StoreRecord | None, list[Finding]]:
    """The record of the sealed store; a finding where it is damaged, or a store has none."""
    try:
        record = store_record(storage)
    except InputError as error:
        problem = f"{error.field}: {error.problem}" if error.field else error.problem
        return None, [curable(RECORD, "sealed", problem, RESEAL)]
    if record is None and any(storage.exists(f"{name}/zarr.json") for name in claimed_names(storage)):
        return None, [curable(RECORD, "sealed", "missing, but there is a store", RESEAL)]
    return record, []


def _check_store(storage: Storage, record: StoreRecord, runs: list[Run], is_sound: bool) -> Iterator[Finding]:
    """Check every file of the store, other files in it, and whether it is outdated.

    `is_sound`: the records and shards of the runs have no findings, so that the content can be compared.
    """
    names = [f"{record.name}/{entry.path}" for entry in record.files]
    checks = storage.concurrent_map(
        lambda one: _problem(storage, *one),
        ((key, entry.size, entry.sha256) for key, entry in zip(names, record.files, strict=True)),
    )
    for key, problem in zip(names, checks, strict=True):
        if problem:
            yield curable(key, "sealed", problem, RESEAL)
    known = set(names)
    for file in storage.list(record.name):
        if file.key not in known and not file.key.endswith(".part"):
            yield curable(file.key, "sealed", "is not a file of the sealed store", RESEAL)
    if not is_sound:
        return
    try:
        contents = read_contents(runs)
        is_stale = (contents.digest(), contents.parts()) != (record.rows_sha256, record.parts)
    except InputError:  # no shard is committed any more
        is_stale = True
    if is_stale:
        lost = sum(len(_lost(run, part)) for run in runs if (part := record.part_of(run.manifest)))
        if lost:
            problem = f"has {lost} shards whose commits are missing"
            yield Finding(RECORD, "lost", problem, "Make them again with `datagen resume`")
        else:
            problem = "is not of the committed shards; nothing is damaged"
            yield curable(record.name, "stale", problem, RESEAL)


def _lost(run: Run, part: SealedPart) -> ShardRanges:
    """Shards of a run that the store has, and that are not committed now."""
    held = run.planned(part.n).without(ShardRanges.between(part.missing))
    return held.without(ShardRanges.of(run.committed()))


def _problem(storage: Storage, key: str, size: int, digest: str) -> str:
    try:
        data = storage.get(key, size)
    except InputError as error:
        return error.problem
    if data is None:
        return "missing"
    is_whole = len(data) == size and sha256(data).hexdigest() == digest
    return "" if is_whole else "has other bytes than were written"


# Arrays that are checked together; every other array is checked by itself.
_KEYS = ("scene_index", "redraws", "sample_id", "sample_scene_index", "candidate_index", "label")


def _check_shard(run: Run, commit: Commit) -> list[Finding]:
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
            if not _same_json(files.get(path), wanted):
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


def _same_json(data: bytes, wanted: bytes) -> bool:
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

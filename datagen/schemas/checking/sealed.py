"""Checks of the sealed store: its files against its record, and its record against the shards."""

from __future__ import annotations

from collections.abc import Iterator
from hashlib import sha256

from datagen.schemas.checking.finding import Finding, Reseal, curable
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.sealing import claimed_names
from datagen.schemas.sealing.contents import (
    RECORD,
    SealedPart,
    StoreRecord,
    read_contents,
    store_record,
)
from datagen.schemas.shard_ranges import ShardRanges
from datagen.schemas.storage import Storage


def read_store(storage: Storage) -> tuple[StoreRecord | None, list[Finding]]:
    """The record of the sealed store; a finding where it is damaged, or a store has none."""
    try:
        record = store_record(storage)
    except InputError as error:
        problem = f"{error.field}: {error.problem}" if error.field else error.problem
        return None, [curable(RECORD, "sealed", problem, Reseal())]
    if record is None and any(storage.exists(f"{name}/zarr.json") for name in claimed_names(storage)):
        return None, [curable(RECORD, "sealed", "missing, but there is a store", Reseal())]
    return record, []


def check_store(storage: Storage, record: StoreRecord, runs: list[Run], is_sound: bool) -> Iterator[Finding]:
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
            yield curable(key, "sealed", problem, Reseal())
    known = set(names)
    for file in storage.list(record.name):
        if file.key not in known and not file.key.endswith(".part"):
            yield curable(file.key, "sealed", "is not a file of the sealed store", Reseal())
    if not is_sound:
        return
    try:
        contents = read_contents(runs)
        is_stale = (contents.digest(), contents.parts()) != (record.rows_sha256, record.parts)
    except InputError:  # no shard is committed any more
        is_stale = True
    if is_stale:
        lost = sum(len(_lost(run, part)) for run in runs if (part := record.part_of(run)))
        if lost:
            problem, fix = (
                f"has {lost} shards whose commits are missing",
                "Make them again with `datagen resume`",
            )
            yield Finding(RECORD, "lost", problem, fix)
        else:
            yield curable(
                record.name, "stale", "is not of the committed shards; nothing is damaged", Reseal()
            )


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
    return (
        ""
        if len(data) == size and sha256(data).hexdigest() == digest
        else "has other bytes than were written"
    )

"""Remove the files of a run that no record names: of unfinished or superseded attempts, drafts and probes.

It is refused while a job is alive, and keeps files of the last hour, which a merge or a worker whose driver
has died may still write and commit.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta

from datagen.schemas.errors import InputError
from datagen.schemas.jobs import Jobs
from datagen.schemas.record_files import object_key
from datagen.schemas.run import Run, open_runs
from datagen.schemas.sealing import store_record
from datagen.schemas.storage import Storage, StoredFile

Seen = Callable[[int, int], None]
_KEPT_S = 3600.0
_DEAD_AFTER = timedelta(days=1)  # a job on another machine without any sign of life
_JOB = re.compile(r"jobs/([^./]+)\.json")
_DRAFT = re.compile(r".+\.[0-9a-f]{16}\.part")
_STORE = re.compile(r"(data(?:-[0-9]+)?\.zarr)/")
_PROBE = re.compile(r"\.probe-[0-9a-f]{16}(?:\.[0-9a-f]{16}\.part)?\Z")


@dataclass
class Cleaned:
    """Counts of removed files."""

    attempts: int = 0
    files: int = 0
    bytes: int = 0


def refuse_running(storage: Storage) -> None:
    """Raise InputError while a job of the runs in `storage` may be alive."""
    jobs = Jobs(storage)
    for name in sorted(found[1] for file in storage.list("jobs") if (found := _JOB.fullmatch(file.key))):
        job = None
        with suppress(InputError):  # a damaged record
            job = jobs.get(name)
        if job is None:
            continue
        health = job.health()
        if health == "live" or (health == "silent" and job.silence() < _DEAD_AFTER):
            problem = f"is running on {job.record.host}"
            fix = "Wait until it has ended, or stop it with `datagen cancel`"
            raise InputError(storage.url, f"job {name}", problem, fix)


def clean_runs(storage: Storage, seen: Seen = lambda done, of: None, kept_s: float = _KEPT_S) -> Cleaned:
    """Remove files that no record names and that are older than `kept_s` seconds.

    `seen` is called with (searched runs, runs). InputError where there is no run, while a job runs, or for a
    damaged commit, whose object would count as spare.
    """
    refuse_running(storage)
    before_s, cleaned, runs = time.time() - kept_s, Cleaned(), open_runs(storage)
    for number, run in enumerate(runs, 1):
        _clean_objects(run, before_s, cleaned)
        seen(number, len(runs))
    for place in ({run.storage.url: run.storage for run in runs} | {storage.url: storage}).values():
        _clean_rest(place, before_s, cleaned)
    return cleaned


def _clean_objects(run: Run, before_s: float, cleaned: Cleaned) -> None:
    """Remove the objects of attempts that did not commit."""
    objects = [file for file in run.storage.list("shards") if file.key.endswith(".zip")]
    # After the listing, so that an attempt that commits meanwhile is not spare.
    committed = {object_key(commit.attempt) for commit in run.commits()}
    spare = [file for file in objects if file.key not in committed and file.modified_s < before_s]
    _remove(run.storage, spare, cleaned)
    cleaned.attempts += len(spare)


def _clean_rest(storage: Storage, before_s: float, cleaned: Cleaned) -> None:
    """Remove drafts, probes, and sealed stores that do not count and are not being written."""
    record = store_record(storage)
    files = [file for file in storage.list("") if not file.key.startswith("parts/")]
    kept = {
        record.name if record else "",
        "",
        *(_store_of(file) for file in files if file.modified_s >= before_s),
    }
    old = [
        file
        for file in files
        if file.modified_s < before_s
        and (_store_of(file) not in kept or _PROBE.match(file.key) or _DRAFT.fullmatch(file.key))
    ]
    _remove(storage, old, cleaned)
    for name in sorted({_store_of(file) for file in old} - kept):
        storage.remove_empty(name)


def _store_of(file: StoredFile) -> str:
    """The sealed store that holds a file, or ""."""
    found = _STORE.match(file.key)
    return found[1] if found else ""


def _remove(storage: Storage, files: list[StoredFile], cleaned: Cleaned) -> None:
    storage.delete([file.key for file in files])
    cleaned.files += len(files)
    cleaned.bytes += sum(file.size for file in files)

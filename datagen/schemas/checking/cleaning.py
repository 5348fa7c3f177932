"""Remove the files of a run that no record names: of unfinished or superseded attempts, drafts and probes.

It is refused while a job is alive, and keeps files of the last hour, which a merge or a worker whose driver
has died may still write. An attempt whose files are removed cannot be committed: `Run.commit` needs them.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from itertools import groupby

from datagen.schemas.errors import InputError
from datagen.schemas.jobs import Jobs
from datagen.schemas.record_files import commit_copy_key, commit_key
from datagen.schemas.run import Run, open_runs
from datagen.schemas.storage import Storage, StoredFile

Seen = Callable[[int, int], None]
_KEPT_S = 3600.0
_DEAD_AFTER = timedelta(days=1)  # a job on another machine without any sign of life
_JOB = re.compile(r"jobs/([^./]+)\.json")
_ATTEMPT = re.compile(r"shards/([0-9]{6,18})/([A-Za-z0-9][A-Za-z0-9_.-]{0,99})/")
_DRAFT = re.compile(r".+\.[0-9a-f]{16}\.part\Z")
_STORE_DRAFT = re.compile(r"(data\.zarr\.[0-9a-f]{16}\.partial)/")
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

    `seen` is called with (searched shards, shards). InputError where there is no run, or while a job runs.
    """
    refuse_running(storage)
    before_s, cleaned, runs = time.time() - kept_s, Cleaned(), open_runs(storage)
    for run in runs:
        _clean_run(run, before_s, seen, cleaned)
    if all(run.storage.url != storage.url for run in runs):  # merged runs
        rest = [file for file in storage.list("") if not file.key.startswith("parts/")]
        _clean_files(storage, rest, before_s, cleaned)
    return cleaned


def _clean_run(run: Run, before_s: float, seen: Seen, cleaned: Cleaned) -> None:
    storage = run.storage
    started = {
        file.key.removeprefix("ledger/").removesuffix(".start.json"): file.modified_s
        for file in storage.list("ledger")
        if file.key.endswith(".start.json")
    }
    committed, searched = len(run.committed()), 0
    for key, group in groupby(storage.list(""), key=_folder_of):
        files = list(group)
        if not (found := _ATTEMPT.fullmatch(f"{key}/")):
            _clean_files(storage, files, before_s, cleaned)
            continue
        shard, attempt = int(found[1]), found[2]
        searched += 1
        seen(min(searched, committed), committed)
        newest_s = max([started.get(attempt, 0.0), *(file.modified_s for file in files)])
        if not _is_spare(run, shard, attempt, files):
            drafts = [file for file in files if _DRAFT.fullmatch(file.key)]
            _remove(storage, [file for file in drafts if file.modified_s < before_s], cleaned)
        elif newest_s < before_s:
            _remove(storage, files, cleaned)
            storage.remove_empty(key)
            cleaned.attempts += 1


def _is_spare(run: Run, shard: int, attempt: str, files: Iterable[StoredFile]) -> bool:
    """Whether no commit names the attempt, nor may: a lost commit is restored from its copy."""
    if not run.storage.exists(commit_key(shard)):
        return all(file.key != commit_copy_key(shard, attempt) for file in files)
    try:
        return run.commit_of(shard).attempt != attempt
    except InputError:
        return False  # a damaged commit: repair it first


def _folder_of(file: StoredFile) -> str:
    """The folder that is removed or kept as a whole, or "" for a single file."""
    for folder in (_ATTEMPT, _STORE_DRAFT):
        if found := folder.match(file.key):
            return found[0].rstrip("/")
    return ""


def _clean_files(
    storage: Storage,
    files: list[StoredFile],
    before_s: float,
    cleaned: Cleaned,
) -> None:
    """Remove garbage outside the folders of attempts: drafts and probes."""
    old = [
        file
        for file in files
        if file.modified_s < before_s and any(kind.match(file.key) for kind in (_PROBE, _DRAFT, _STORE_DRAFT))
    ]
    _remove(storage, old, cleaned)
    for folder in {found[1] for file in old if (found := _STORE_DRAFT.match(file.key))}:
        storage.remove_empty(folder)


def _remove(storage: Storage, files: list[StoredFile], cleaned: Cleaned) -> None:
    storage.delete([file.key for file in files])
    cleaned.files += len(files)
    cleaned.bytes += sum(file.size for file in files)

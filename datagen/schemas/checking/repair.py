"""Repair a run: restore records from their copies, set aside what is damaged, and seal again; and clean it.

A shard that is set aside is missing, and `datagen resume` makes it again from specification and assets.
An interrupted repair is continued by the next one. Cleaning removes files that no record names: of unfinished
or superseded attempts, drafts and probes. It keeps files of the last hour, which a merge or a worker whose
driver has died may still write and commit. Both are refused while a job is alive.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from secrets import token_hex

from datagen.schemas.checking.check_runs import Checked, check_runs
from datagen.schemas.checking.finding import RESEAL, Finding, SetAside, folder_of, read
from datagen.schemas.errors import InputError
from datagen.schemas.jobs import Jobs
from datagen.schemas.record_files import SET_ASIDE, commit_key, object_key, superseded_end
from datagen.schemas.run import label_counts, open_runs
from datagen.schemas.run_records import MAX_FILE_BYTES, Commit, foreign_field
from datagen.schemas.sealing import CLAIM, RECORD, SEALED, remove_store, seal, store_record
from datagen.schemas.shard_ranges import ShardRanges
from datagen.schemas.storage import Storage, StoredFile

Seen = Callable[[int, int], None]
# Restoring a record reveals what depends on it: commits, then shards, then the sealed store.
_PASSES = 6
# Kinds of findings that do not keep a run from being sealed.
_HARMLESS = ("account", "sealed", "stale")
_CAUSE = "its shard was set aside by datagen verify --repair"


@dataclass
class Repaired:
    """The result of a repair: keys relative to the checked path, and the findings that are left."""

    restored: list[str] = field(default_factory=list[str])
    set_aside: list[str] = field(default_factory=list[str])  # commits of shards, and single files
    into: str = ""  # the folder that holds what was set aside
    resealed: bool = False
    left: list[Finding] = field(default_factory=list[Finding])
    checked: Checked = field(default_factory=Checked)


def repair_runs(storage: Storage, seen: Seen = lambda done, total: None) -> Repaired:
    """Check, repair what can be repaired, and check again, until nothing more can be repaired.

    InputError as `check_runs`, and while a job of the run may be alive.
    """
    refuse_running(storage)
    result = Repaired(into=f"{SET_ASIDE}/{datetime.now(UTC):%Y%m%dT%H%M%S}-{token_hex(4)}")
    refused: dict[str, str] = {}  # why the repair of a file failed, by its key
    for _ in range(_PASSES):
        result.checked = Checked()
        result.left = [
            replace(finding, fix=refused[finding.key], cure=None) if finding.key in refused else finding
            for finding in check_runs(storage, result.checked, seen)
        ]
        if not _repair_once(storage, result, refused):
            break
    return result


def _repair_once(storage: Storage, result: Repaired, refused: dict[str, str]) -> bool:
    """Restore records; where there are none, set aside; where there is nothing, seal. Whether it did any."""
    restores = [(f.key, f.cure) for f in result.left if isinstance(f.cure, bytes)]
    for key, cure in restores:
        with _noting(refused, key):
            storage.put(key, cure)
            result.restored.append(key)
    if restores:
        return True
    aside = {_key_of(storage, f): f for f in result.left if isinstance(f.cure, SetAside)}
    for key, finding in aside.items():
        with _noting(refused, finding.key):
            _set_aside(storage, key, finding, result.into)
            result.set_aside.append(key)
    return bool(aside) or _reseal(storage, result)


@contextmanager
def _noting(refused: dict[str, str], key: str) -> Generator[None]:
    try:
        yield
    except InputError as error:
        refused[key] = f"{error.problem}. {error.fix}"


def _key_of(storage: Storage, finding: Finding) -> str:
    """Key of the commit of the finding's shard where that is set aside, else of its file."""
    if isinstance(finding.cure, SetAside) and finding.cure.run is not None and finding.shard is not None:
        return f"{folder_of(storage, finding.cure.run.storage)}{commit_key(finding.shard)}"
    return finding.key


def _set_aside(storage: Storage, key: str, finding: Finding, into: str) -> None:
    """Move the commit and the object of a shard, or one file. The shard's attempt becomes superseded."""
    run = finding.cure.run if isinstance(finding.cure, SetAside) else None
    if run is None or finding.shard is None:
        _move(storage, [key], into)
        return
    commit = read(run.storage, commit_key(finding.shard), Commit).record
    if commit is not None and foreign_field(run.manifest, finding.shard, commit):
        commit = None  # the object that it names is not this shard's
    rows = f"{folder_of(storage, run.storage)}{object_key(commit.attempt)}" if commit else ""
    _move(storage, [rows, key] if rows else [key], into)  # the commit last: without it nothing is found
    if commit is not None:
        run.ledger.end(superseded_end(commit, _CAUSE))


def _move(storage: Storage, keys: Iterable[str], into: str) -> None:
    """Move files into a folder: each exists there, durably, before it is removed."""
    for key in keys:
        data = storage.get(key, MAX_FILE_BYTES)
        if data is not None:
            storage.put_new(f"{into}/{key}", data)
            storage.delete([key])


def _reseal(storage: Storage, result: Repaired) -> bool:
    """Seal the run unless its store is up to date; return whether it was sealed.

    It is not sealed where records that decide its rows are damaged, or plans are lost.
    """
    odd = [finding for finding in result.left if finding.cure is not None]
    if result.resealed or (result.checked.is_sealed and not odd):
        return False
    why = "Repair the other findings first: the run cannot be sealed before"
    kinds = {finding.kind for finding in result.left}
    # A store that holds lost shards is kept until these are made again, unless it is damaged itself.
    if kinds <= {*_HARMLESS, *({"lost"} if "sealed" in kinds else ())}:
        try:
            runs = open_runs(storage)
            if not any(
                ShardRanges.of(run.committed()).without(run.planned()) for run in runs if not run.scenes
            ):
                result.resealed = True
                has_labels = label_counts(runs).labels > 0
                if "sealed" in kinds:  # an undamaged store is replaced once the new one is written
                    _forget_store(storage)
                if has_labels:
                    seal(storage)
                return result.checked.is_sealed or has_labels
            why = "More shards are committed than wanted: raise the number with `datagen resume --n`"
        except InputError as error:
            why = str(error)
    for number, finding in enumerate(result.left):
        if finding.cure == RESEAL:
            result.left[number] = replace(finding, fix=why, cure=None)
    result.left = result.left or [Finding(SEALED, "sealed", "cannot be made", why)]
    return False


def _forget_store(storage: Storage) -> None:
    """Remove a damaged store, its record first."""
    record = None
    with suppress(InputError):  # its record is damaged
        record = store_record(storage)
    storage.delete([RECORD])
    if record is not None:
        remove_store(storage, record.name)
        storage.delete([f"{record.name}{CLAIM}"])  # no job runs: the next store may have its name


_KEPT_S = 3600.0
_DEAD_AFTER = timedelta(days=1)  # a job on another machine without any sign of life
_JOB = re.compile(r"jobs/([^./]+)\.json")
_LEFT = re.compile(r".+\.[0-9a-f]{16}\.part|\.probe-[0-9a-f]{16}")  # drafts and probes
_STORE = re.compile(r"(data(?:-[0-9]+)?\.zarr)/")


@dataclass
class Cleaned:
    """Counts of removed files."""

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
            if health == "silent":
                problem += f", or was: it gave no sign for {job.silence().total_seconds() / 60:.0f} min"
                fix = f"If that machine is gone, remove jobs/{name}.json there: no label depends on it"
            raise InputError(storage.url, f"job {name}", problem, fix)


def clean_runs(storage: Storage, seen: Seen = lambda done, of: None, kept_s: float = _KEPT_S) -> Cleaned:
    """Remove files that no record names and that are older than `kept_s` seconds.

    `seen` is called with (searched runs, runs). InputError where there is no run, while a job runs, or for a
    damaged commit, whose object would count as spare.
    """
    refuse_running(storage)
    before_s, cleaned, runs = time.time() - kept_s, Cleaned(), open_runs(storage)
    for number, run in enumerate(runs, 1):
        objects = [file for file in run.storage.list("shards") if file.key.endswith(".zip")]
        # After the listing, so that an attempt that commits meanwhile is not spare.
        committed = {object_key(commit.attempt) for commit in run.commits()}
        spare = [file for file in objects if file.key not in committed and file.modified_s < before_s]
        _remove(run.storage, spare, cleaned)
        seen(number, len(runs))
    for place in ({run.storage.url: run.storage for run in runs} | {storage.url: storage}).values():
        _clean_rest(place, before_s, cleaned)
    return cleaned


def _clean_rest(storage: Storage, before_s: float, cleaned: Cleaned) -> None:
    """Remove drafts, probes, and sealed stores that do not count and are not being written."""
    record = store_record(storage)
    files = [file for file in storage.list("") if not file.key.startswith("parts/")]
    kept = {record.name if record else "", ""}
    kept |= {_store_of(file) for file in files if file.modified_s >= before_s}
    old = [
        file
        for file in files
        if file.modified_s < before_s and (_store_of(file) not in kept or _LEFT.fullmatch(file.key))
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

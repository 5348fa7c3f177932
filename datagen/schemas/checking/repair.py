"""Repair a run: restore records from their copies, set aside what is damaged, and seal again.

A shard that is set aside is missing, and `datagen resume` makes it again from specification and assets.
An interrupted repair is continued by the next one.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from secrets import token_hex

from datagen.schemas.checking.check_runs import Checked, check_runs
from datagen.schemas.checking.cleaning import refuse_running
from datagen.schemas.checking.finding import Finding, Reseal, Restore, SetAside, read
from datagen.schemas.errors import InputError
from datagen.schemas.record_files import SET_ASIDE, commit_key, encode_record, end_key
from datagen.schemas.run import Run, label_counts, open_runs
from datagen.schemas.run_records import LedgerEntry
from datagen.schemas.sealing import SEALED, seal, unseal
from datagen.schemas.storage import Storage

# Restoring a record reveals what depends on it: commits, then shards, then the sealed store.
_PASSES = 6
# Kinds of findings that do not keep a run from being sealed.
_HARMLESS = ("account", "sealed", "stale")
_CAUSE = "its shard was set aside by datagen verify --repair"

Seen = Callable[[int, int], None]


@dataclass
class Repaired:
    """The result of a repair: keys relative to the checked path, and the findings that are left."""

    restored: list[str] = field(default_factory=list[str])
    set_aside: list[str] = field(default_factory=list[str])  # folders of shards, and single files
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
    restores = [(f.key, f.cure) for f in result.left if isinstance(f.cure, Restore)]
    for key, cure in restores:
        with _noting(refused, key):
            is_put = storage.put_new(key, cure.data) if cure.is_guess else _put(storage, key, cure.data)
            result.restored += [key] * is_put
    if restores:
        return True
    aside = {_folder_of(storage, finding): finding for finding in result.left}
    aside = {key: finding for key, finding in aside.items() if isinstance(finding.cure, SetAside)}
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


def _put(storage: Storage, key: str, data: bytes) -> bool:
    storage.put(key, data)
    storage.sync([key])
    return True


def _folder_of(storage: Storage, finding: Finding) -> str:
    """Key of the folder of the finding's shard where that is set aside, else of its file."""
    if isinstance(finding.cure, SetAside) and finding.cure.run is not None:
        return f"{_prefix(storage, finding.cure.run)}shards/{finding.shard:06d}"
    return finding.key


def _prefix(storage: Storage, run: Run) -> str:
    return f"{run.storage.url.removeprefix(storage.url)}/".lstrip("/")


def _set_aside(storage: Storage, key: str, finding: Finding, into: str) -> None:
    """Move the files of a shard, commit first, or one file. The shard's attempts become superseded."""
    run = finding.cure.run if isinstance(finding.cure, SetAside) else None
    if run is None or finding.shard is None:
        _move(storage, [key], into)
        return
    keys = [file.key for file in storage.list(key)]
    commit = f"{_prefix(storage, run)}{commit_key(finding.shard)}"
    _move(storage, [commit, *keys] if storage.exists(commit) else keys, into)
    storage.remove_empty(key)
    for attempt in sorted({file.removeprefix(f"{key}/").split("/")[0] for file in keys}):
        end = read(run.storage, end_key(attempt), LedgerEntry).record
        if end is not None and (end.outcome, end.shard) == ("committed", finding.shard):
            spare = end.model_copy(update={"outcome": "superseded", "cause": _CAUSE})
            _put(run.storage, end_key(attempt), encode_record(spare))


def _move(storage: Storage, keys: Iterable[str], into: str) -> None:
    """Move files into a folder: all exist there, durably, before the first is removed."""
    pairs = [(key, f"{into}/{key}") for key in keys]
    storage.adopt_many(storage, pairs)
    storage.sync(new for _, new in pairs)
    for key, _ in pairs:
        storage.delete([key])


def _reseal(storage: Storage, result: Repaired) -> bool:
    """Seal the run unless its store is up to date; return whether it was sealed.

    It is not sealed where records that decide its rows are damaged, or plans are lost.
    """
    odd = [finding for finding in result.left if finding.cure is not None]
    if result.resealed or (result.checked.is_sealed and not odd):
        return False
    why = "Repair the other findings first: the run cannot be sealed before"
    if not any(finding.kind not in _HARMLESS for finding in result.left):
        try:
            runs = open_runs(storage)
            if any(run.committed() - set(run.planned()) for run in runs):
                why = "More shards are committed than wanted: raise the number with `datagen resume --n`"
            else:
                result.resealed = True
                has_labels = label_counts(runs).labels > 0
                if storage.folder is None or not has_labels:
                    unseal(storage)  # in an object store, a chunk of the old store may be damaged
                if has_labels:
                    seal(storage)
                return result.checked.is_sealed or has_labels
        except InputError as error:
            why = str(error)
    kept = [finding for finding in result.left if not isinstance(finding.cure, Reseal)]
    outdated = [replace(finding, fix=why, cure=None) for finding in result.left if finding not in kept]
    if not result.left:
        outdated = [Finding(SEALED, "sealed", "cannot be made", why)]
    result.left = [*kept, *outdated]
    return False

"""Checks of the JSON records of a run, or of merged runs: at the root, plans, jobs, ledger, quarantine."""

from __future__ import annotations

import re
from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass

from datagen.schemas.checking.finding import (
    BACKUP,
    AnyRecord,
    Finding,
    Kind,
    SetAside,
    below,
    compare,
    curable,
    folder_of,
    read,
    sound,
)
from datagen.schemas.errors import InputError
from datagen.schemas.record_files import (
    MERGED,
    copy_key,
    encode_record,
    end_key,
    is_guess,
    lost_end,
    refuse_other_format,
    start_from_end,
    start_key,
    utc_now,
)
from datagen.schemas.run import Run
from datagen.schemas.run_records import (
    FORMAT_VERSION,
    AttemptStart,
    Commit,
    LedgerEntry,
    Manifest,
    Merged,
    MergedPart,
    Plan,
    QuarantineRecord,
    other_value,
)
from datagen.schemas.shard_ranges import ShardRanges
from datagen.schemas.storage import Storage

_MANIFEST = "manifest.json"
_BROKEN_OFF = "Merge the runs again: it finishes a merge that was interrupted"
_LIFTED = re.compile(r"\.lifted-[1-9][0-9]{0,8}\.json\Z")  # a record whose shard was released
_OF_ANOTHER = "is the record of another"


def open_roots(storage: Storage) -> tuple[list[Run], list[Finding]]:
    """Open the run, or the parts, in `storage` from undamaged copies of the records at its root.

    Returns also the findings on these. InputError where there is no run, or one of another format.
    """
    parts, findings = _merged_parts(storage)
    if parts is None:
        run, found = _open_run(storage)
        if run is None and not found:
            raise InputError(storage.url, _MANIFEST, "not a run: no such file", "Name a run's folder")
        return [run] if run else [], found
    runs: list[Run] = []
    for part in parts:
        run, found = None, list[Finding]()
        place = storage.below(part.folder)
        if next(iter(storage.list(part.folder)), None) is not None:
            run, found = _open_run(place, part.spec_hash)
        if run is None and not found:
            found = [Finding(_MANIFEST, "record", "missing, as is its copy", "Merge the runs again")]
        findings += below(folder_of(storage, place), found)
        if run is not None:
            runs.append(Run(place, run.manifest, ShardRanges.between(part.scenes)))
    return runs, findings


def _merged_parts(storage: Storage) -> tuple[tuple[MergedPart, ...] | None, list[Finding]]:
    ours, copy = read(storage, MERGED, Merged), read(storage, copy_key(MERGED), Merged)
    merged = sound(ours, copy)
    if merged is not None:
        refuse_other_format(f"{storage.url}/{MERGED}", merged.format_version)
        return merged.parts, compare(ours, copy, fix=_BROKEN_OFF)
    if ours.problem == copy.problem == "missing":
        return None, []
    return (), compare(ours, copy)


def _open_run(storage: Storage, spec_hash: str | None = None) -> tuple[Run | None, list[Finding]]:
    """Open the run; it must have this specification where one is given."""

    def refuse(manifest: Manifest) -> str:
        if spec_hash not in (None, manifest.spec_hash):
            return "belongs to another run"
        if manifest.format_version == FORMAT_VERSION and manifest.spec.hash() != manifest.spec_hash:
            return "spec_hash: is not the hash of the specification in the record"
        return ""

    ours = read(storage, _MANIFEST, Manifest, refuse)
    copy = read(storage, copy_key(_MANIFEST), Manifest, refuse)
    manifest = sound(ours, copy)
    if ours.record and copy.record and ours.record.spec_hash != copy.record.spec_hash:
        named = _named(storage)
        if len(named) == 1 and named < {ours.record.spec_hash, copy.record.spec_hash}:
            return _open_run(storage, named.pop())
    if manifest is None:
        return None, compare(ours, copy)
    refuse_other_format(f"{storage.url}/{_MANIFEST}", manifest.format_version)
    return Run(storage, manifest), compare(ours, copy)


def _named(storage: Storage) -> set[str]:
    commits = (read(storage, file.key, Commit).record for file in storage.list("commits"))
    plans = (read(storage, file.key, Plan).record for file in storage.list("plans"))
    return {record.spec_hash for record in (*commits, *plans) if record and record.spec_hash}


def check_plans(run: Run) -> list[Finding]:
    """Check plans: each has its copy, and a larger n than the one before."""
    findings: list[Finding] = []
    n = last = 0
    fix = "Restore the file from a backup, or set the number again with `datagen resume RUN --n N`"
    for number in sorted(run.numbers("plans", width=1) | run.numbers(copy_key("plans"), width=1)):
        key, expected = f"plans/{number}.json", {"spec_hash": run.manifest.spec_hash, "number": number}
        if number > last + 1:
            findings.append(Finding(f"plans/{last + 1}.json", "record", "missing, as is its copy", fix))
        ours, copy = (
            read(run.storage, k, Plan, lambda plan, e=expected: ": ".join(other_value(plan, **e) or ()))
            for k in (key, copy_key(key))
        )
        findings += compare(ours, copy)
        plan, last = sound(ours, copy), number
        if plan is not None and plan.n <= n:
            problem = f"n: {plan.n} is not more than in the plan before"
            findings.append(Finding(key, "record", problem, "Remove the plan"))
        n = max(n, plan.n if plan else 0)
    if not n:
        findings.append(Finding("plans", "record", "has no plan with the number of samples wanted", fix))
    return findings


def check_notes(storage: Storage) -> Iterator[Finding]:
    """Check the records of jobs, on which no row depends; their states may be torn by a power cut."""
    for file in storage.list("jobs"):
        is_record = file.key.endswith(".json") and not file.key.endswith(".state.json")
        if is_record and (problem := read(storage, file.key, AnyRecord).problem):
            yield curable(file.key, "record", problem, SetAside())


@dataclass
class LedgerTotals:
    """Sums of wall seconds in the records."""

    committed_wall_s: float = 0.0
    wasted_wall_s: float = 0.0
    attempts: int = 0
    without_account: int = 0
    unfinished: int = 0  # began, not ended, and may still run


def check_ledger(run: Run, committed: Mapping[int, str], totals: LedgerTotals) -> Iterator[Finding]:
    """Check every ledger record, given the `committed` attempts (shard -> attempt); add to the sums."""
    names: set[str] = set()
    for file in run.storage.list("ledger"):
        name = file.key.removeprefix("ledger/")
        if name.endswith(".json") and "/" not in name:
            names.add(name.removesuffix(".json"))
        elif not name.endswith(".part"):  # left by a killed writer
            yield curable(file.key, "foreign", "is not a record of the ledger", SetAside())
    shards = {attempt: shard for shard, attempt in committed.items()}
    decided = committed.keys() | run.quarantined()
    for attempt in sorted({name.removesuffix(".start") for name in names} | shards.keys()):
        if attempt in shards:
            yield from _check_start(run, attempt, shards[attempt])
            end = read(run.storage, end_key(attempt), LedgerEntry)
            if attempt in names and not (end.record and is_guess(end.record)):
                problem = "is the end of an attempt that has a commit"
                yield curable(end_key(attempt), "account", problem, SetAside(), shards[attempt])
            continue
        totals.attempts += 1
        if attempt in names:
            yield from _check_end(run, attempt, totals)
        else:
            yield from _check_unfinished(run, attempt, decided, totals)


def _check_start(run: Run, attempt: str, shard: int) -> Iterator[Finding]:
    """The start of a committed attempt, which its commit restores without the time."""
    start = read(run.storage, start_key(attempt), AttemptStart)
    problem = start.problem
    if start.record is not None and (start.record.attempt, start.record.shard) != (attempt, shard):
        problem = _OF_ANOTHER
    if problem:
        known = encode_record(AttemptStart(attempt=attempt, shard=shard, started=""))
        yield curable(start.key, "account", problem, known, shard)


def _check_end(run: Run, attempt: str, totals: LedgerTotals) -> Iterator[Finding]:
    end, start = (
        read(run.storage, end_key(attempt), LedgerEntry, lambda e: _misnamed(e.attempt, attempt)),
        read(run.storage, start_key(attempt), AttemptStart, lambda s: _misnamed(s.attempt, attempt)),
    )
    if end.record is None:
        yield _misplaced(end.key, "account", end.problem)
        return
    noted = end.record
    if start.record is None:
        yield curable(start.key, "account", start.problem, encode_record(start_from_end(noted)), noted.shard)
    totals.without_account += noted.cost is None
    totals.wasted_wall_s += noted.cost.wall_s if noted.cost else 0.0


def _check_unfinished(
    run: Run, attempt: str, decided: Container[int], totals: LedgerTotals
) -> Iterator[Finding]:
    key = start_key(attempt)
    start = read(run.storage, key, AttemptStart, lambda s: _misnamed(s.attempt, attempt))
    if start.record is None:
        yield _misplaced(key, "account", start.problem)
    elif start.record.shard in decided:
        totals.without_account += 1
        problem = "missing, but its shard is decided; the cost is unknown"
        cure = encode_record(lost_end(start.record, utc_now()))
        yield curable(end_key(attempt), "account", problem, cure, start.record.shard)
    else:
        totals.unfinished += 1


def _misplaced(key: str, kind: Kind, problem: str) -> Finding:
    """A damaged record, which is set aside, or an undamaged one in the place of another, which is not."""
    if problem == "missing":
        return Finding(key, kind, problem, BACKUP)
    if problem == _OF_ANOTHER:
        return Finding(key, kind, problem, "Give it back the name of its own attempt or shard")
    return curable(key, kind, problem, SetAside())


def check_quarantine(run: Run) -> Iterator[Finding]:
    """Check the records of quarantined shards. A shard whose record is set aside is tried again."""
    for file in run.storage.list("quarantine"):
        name = file.key.removeprefix("quarantine/")
        if name.endswith(".part"):
            continue
        record = read(run.storage, file.key, QuarantineRecord)
        problem = record.problem
        if record.record is not None:
            shard = record.record.shard
            problem = _misnamed(f"{shard:06d}.json", _LIFTED.sub(".json", name))
            first, seed = shard * run.layout.scenes_per_shard, run.manifest.spec.seed
            problem = problem or ": ".join(other_value(record.record, seed=seed, first_scene=first) or ())
        if problem:
            yield _misplaced(file.key, "record", problem)


def _misnamed(named: str, file: str) -> str:
    return "" if named == file else _OF_ANOTHER

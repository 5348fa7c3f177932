"""Checks of the records of attempts: commits with their copies, the ledger, and the quarantine."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from pydantic import BaseModel

from datagen.schemas.checking.finding import (
    BACKUP,
    AnyRecord,
    Finding,
    Kind,
    Read,
    Restore,
    SetAside,
    compare,
    curable,
    read,
)
from datagen.schemas.errors import InputError
from datagen.schemas.quarantine import name_before
from datagen.schemas.record_files import (
    commit_copy_key,
    commit_key,
    decode_record,
    encode_record,
    end_from_commit,
    end_key,
    lost_end,
    start_from_end,
    start_key,
    utc_now,
)
from datagen.schemas.run import Run
from datagen.schemas.run_records import (
    AttemptStart,
    Commit,
    Cost,
    LedgerEntry,
    QuarantineRecord,
    foreign_field,
    other_value,
)
from datagen.schemas.storage import Storage, StoredFile

Ledgered = TypeVar("Ledgered", AttemptStart, LedgerEntry)

_ROUNDING = 1e-6
_ROUNDING_S = 1e-3  # clocks are rounded to milliseconds
_OF_ANOTHER = "is the record of another"
ODD_COST_FIX = "Find out which program wrote it: the record is undamaged"


@dataclass(frozen=True, eq=False)
class CheckedShard:
    """A shard that is or was committed, with its commit where one of the two files is undamaged."""

    shard: int
    commit: Commit | None
    findings: tuple[Finding, ...]


def check_commit(run: Run, shard: int, listed: Mapping[str, StoredFile]) -> CheckedShard:
    """Check the shard's commit and its copy, among the files listed below the shard's folder.

    Without a commit file, a copy counts only where the caller knows that there was a commit.
    """
    ours = read(run.storage, commit_key(shard), Commit, lambda c: _foreign_to(run, shard, c))
    if ours.record is not None:
        attempt = ours.record.attempt
        copy = _copy(run, shard, attempt)
        is_won = copy.data == ours.data or _is_committed_in_ledger(run, shard, attempt)
        copies = [] if is_won else _sound_copies(run, shard, listed)
        if not any(c.record and _is_committed_in_ledger(run, shard, c.record.attempt) for c in copies):
            return CheckedShard(shard, ours.record, tuple(compare(ours, copy, shard)))
        # The record of a superseded attempt, or of another run of the specification, replaced it.
        ours = Read(ours.key, ours.data, None, "is not that of the committed attempt")
    copies = _sound_copies(run, shard, listed)
    if len(copies) > 1:  # killed superseded attempts left theirs too
        copies = [c for c in copies if c.record and _is_committed_in_ledger(run, shard, c.record.attempt)]
    if len(copies) == 1:
        return CheckedShard(shard, copies[0].record, tuple(compare(ours, copies[0], shard)))
    if not listed and ours.data is None and ours.problem == "missing":
        return CheckedShard(shard, None, ())  # there is nothing to commit
    problem = f"{ours.problem}, and {'there is no copy' if not copies else 'several attempts left copies'}"
    return CheckedShard(shard, None, (curable(ours.key, "lost", problem, SetAside(run), shard),))


def _sound_copies(run: Run, shard: int, listed: Mapping[str, StoredFile]) -> list[Read[Commit]]:
    """The undamaged copies of commits in the folders of a shard's attempts."""
    names = [key.split("/") for key in sorted(listed)]
    copies = (_copy(run, shard, n[2]) for n in names if len(n) == 4 and n[3] == "commit.json")
    return [copy for copy in copies if copy.record is not None]


def _copy(run: Run, shard: int, attempt: str) -> Read[Commit]:
    def refuse(commit: Commit) -> str:
        return _foreign_to(run, shard, commit) or "is another attempt's" * (commit.attempt != attempt)

    return read(run.storage, commit_copy_key(shard, attempt), Commit, refuse)


def _foreign_to(run: Run, shard: int, commit: Commit) -> str:
    return ": ".join(foreign_field(run.manifest, shard, commit) or ())


def check_account(run: Run, commit: Commit) -> list[Finding]:
    """Check the start and the end of a committed attempt: both exist, the end has the commit's cost."""
    shard = commit.shard
    start = read(run.storage, start_key(commit.attempt), AttemptStart)
    end = read(run.storage, end_key(commit.attempt), LedgerEntry)
    findings: list[Finding] = []
    problem = end.problem
    if end.record is not None:
        expected = {"attempt": commit.attempt, "shard": shard, "outcome": "committed", "cost": commit.cost}
        if found := other_value(end.record, **expected):
            problem = f"{found[0]}: differs from the attempt's commit"
        elif end.record.cost is None:
            problem = "cost: differs from the attempt's commit"
    if problem:
        known = end_from_commit(commit, start.record.started if start.record else "")
        problem = f"{problem}; the commit has it"
        findings.append(_account_finding(run.storage, end, problem, known, shard))
    problem = start.problem
    if start.record is not None and (start.record.attempt, start.record.shard) != (commit.attempt, shard):
        problem = "belongs to another attempt"
    if problem:
        known = start_from_end(end_from_commit(commit, end.record.started if end.record else ""))
        findings.append(_account_finding(run.storage, start, problem, known, shard))
    if odd := odd_cost(commit.cost):
        findings.append(Finding(commit_key(shard), "account", odd, ODD_COST_FIX, shard))
    return findings


def odd_cost(cost: Cost | None) -> str:
    """Why a cost is inconsistent, or ""."""
    if cost is None:
        return ""
    for name, stages, whole in (
        ("wall", cost.stage_wall_s, cost.wall_s),
        ("cpu", cost.stage_cpu_s, cost.cpu_s),
    ):
        total = sum(stages.values())
        if total > whole * (1 + _ROUNDING) + _ROUNDING_S:
            return f"cost.stage_{name}_s: the stages sum to {total:g} s, but the attempt has {whole:g} s"
    return ""


def _is_committed_in_ledger(run: Run, shard: int, attempt: str) -> bool:
    end = read(run.storage, end_key(attempt), LedgerEntry).record
    return end is not None and (end.outcome, end.attempt, end.shard) == ("committed", attempt, shard)


def _account_finding(
    storage: Storage, found: Read[Any], problem: str, known: BaseModel, shard: int
) -> Finding:
    """The finding for a wrong ledger record; not repairable where it is the only copy of another record."""
    try:
        other = decode_record("", found.data or b"", AnyRecord).model_extra or {}
    except InputError:
        other = {}
    key_of = end_key if "outcome" in other else start_key
    home = key_of(str(other.get("attempt"))[:100])
    if "attempt" in other and home != found.key and read(storage, home, AnyRecord).data != found.data:
        return Finding(found.key, "account", problem, f"Move it to {home} and restore this file", shard)
    return curable(found.key, "account", problem, Restore(encode_record(known)), shard)


@dataclass
class LedgerTotals:
    """Sums of wall seconds in the records: the ledger's must equal commits plus waste."""

    committed_wall_s: float = 0.0
    wasted_wall_s: float = 0.0
    attempts: int = 0
    without_account: int = 0
    unfinished: int = 0  # began, not ended, and may still run
    lost_shards: dict[int, str] = field(default_factory=dict[int, str])  # committed only by the ledger


def check_rest(run: Run, committed: Mapping[int, str], totals: LedgerTotals) -> Iterator[Finding]:
    """Check every ledger record except those of `committed` attempts (shard -> attempt); add to the sums."""
    names: set[str] = set()
    for file in run.storage.list("ledger"):
        name = file.key.removeprefix("ledger/")
        if name.endswith(".json") and "/" not in name:
            names.add(name.removesuffix(".json"))
        elif not name.endswith(".part"):  # left by a killed writer
            yield curable(file.key, "foreign", "is not a record of the ledger", SetAside())
    decided = committed.keys() | run.quarantined()
    attempts = {name.removesuffix(".start") for name in names} - set(committed.values())
    for attempt in sorted(attempts):
        if attempt in names:
            yield from _check_end(run, attempt, committed, totals)
        else:
            yield from _check_unfinished(run, attempt, decided, totals)
        totals.attempts += 1


def _check_end(
    run: Run, attempt: str, committed: Mapping[int, str], totals: LedgerTotals
) -> Iterator[Finding]:
    end, start = _read(run, attempt, end_key, LedgerEntry), _read(run, attempt, start_key, AttemptStart)
    if end.record is None:
        for one in (end, start):
            if one.problem:
                yield _unknown(one)
        return
    noted = end.record
    if start.record is None:
        yield _account_finding(run.storage, start, start.problem, start_from_end(noted), noted.shard)
    if odd := odd_cost(noted.cost):
        yield Finding(end.key, "account", odd, ODD_COST_FIX, noted.shard)
    totals.without_account += noted.cost is None
    totals.wasted_wall_s += noted.cost.wall_s if noted.cost else 0.0
    if noted.outcome == "committed" and noted.shard not in committed:
        totals.lost_shards[noted.shard] = attempt


def _check_unfinished(
    run: Run, attempt: str, decided: Container[int], totals: LedgerTotals
) -> Iterator[Finding]:
    start = _read(run, attempt, start_key, AttemptStart)
    if start.record is None:
        yield _unknown(start)
    elif start.record.shard in decided:
        totals.without_account += 1
        problem = "missing, but its shard is decided; the cost is unknown"
        cure = Restore(encode_record(lost_end(start.record, utc_now())), is_guess=True)
        yield curable(end_key(attempt), "account", problem, cure, start.record.shard)
    else:
        totals.unfinished += 1


def _unknown(one: Read[Any]) -> Finding:
    """A bad record whose content follows from no other one: set aside, its attempt has no known cost."""
    if one.data is None:
        return Finding(one.key, "account", one.problem, BACKUP)
    return _misplaced(one.key, "account", one.problem)


def _misplaced(key: str, kind: Kind, problem: str) -> Finding:
    """A damaged record, which is set aside, or an undamaged one in the place of another, which is not."""
    if problem == _OF_ANOTHER:
        return Finding(key, kind, problem, "Give it back the name of its own attempt or shard")
    return curable(key, kind, problem, SetAside())


def _read(run: Run, attempt: str, key_of: Callable[[str], str], model: type[Ledgered]) -> Read[Ledgered]:
    return read(run.storage, key_of(attempt), model, lambda record: _misnamed(record.attempt, attempt))


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
            problem = _misnamed(f"{shard:06d}.json", name_before(name))
            first, seed = shard * run.layout.scenes_per_shard, run.manifest.spec.seed
            problem = problem or ": ".join(other_value(record.record, seed=seed, first_scene=first) or ())
        if problem:
            yield _misplaced(file.key, "record", problem)


def _misnamed(named: str, file: str) -> str:
    return "" if named == file else _OF_ANOTHER

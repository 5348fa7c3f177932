"""Checks of the records of attempts: commits, the ledger, and the quarantine."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass

from datagen.schemas.checking.finding import BACKUP, Finding, Kind, Restore, SetAside, curable, read
from datagen.schemas.quarantine import name_before
from datagen.schemas.record_files import (
    commit_key,
    encode_record,
    end_key,
    is_guess,
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

_ROUNDING = 1e-6
_ROUNDING_S = 1e-3  # clocks are rounded to milliseconds
_OF_ANOTHER = "is the record of another"
ODD_COST_FIX = "Find out which program wrote it: the record is undamaged"


@dataclass(frozen=True, eq=False)
class CheckedShard:
    """A committed shard, with its commit where that is undamaged."""

    shard: int
    commit: Commit | None
    findings: tuple[Finding, ...]


def check_commit(run: Run, shard: int) -> CheckedShard:
    """Check the shard's commit; a damaged one is set aside, and the shard made again."""
    found = read(
        run.storage,
        commit_key(shard),
        Commit,
        lambda c: ": ".join(foreign_field(run.manifest, shard, c) or ()),
    )
    if found.record is None:
        cure = SetAside(run)
        return CheckedShard(shard, None, (curable(found.key, "record", found.problem, cure, shard),))
    odd = odd_cost(found.record.cost)
    findings = [Finding(found.key, "account", odd, ODD_COST_FIX, shard)] if odd else []
    return CheckedShard(shard, found.record, tuple(findings))


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
        known = Restore(encode_record(AttemptStart(attempt=attempt, shard=shard, started="")))
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
        yield curable(
            start.key, "account", start.problem, Restore(encode_record(start_from_end(noted))), noted.shard
        )
    if odd := odd_cost(noted.cost):
        yield Finding(end.key, "account", odd, ODD_COST_FIX, noted.shard)
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
        cure = Restore(encode_record(lost_end(start.record, utc_now())))
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
            problem = _misnamed(f"{shard:06d}.json", name_before(name))
            first, seed = shard * run.layout.scenes_per_shard, run.manifest.spec.seed
            problem = problem or ": ".join(other_value(record.record, seed=seed, first_scene=first) or ())
        if problem:
            yield _misplaced(file.key, "record", problem)


def _misnamed(named: str, file: str) -> str:
    return "" if named == file else _OF_ANOTHER

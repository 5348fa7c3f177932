"""Checks of the ledger except the records of committed attempts, and of the quarantine."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from datagen.schemas.checking.commits import ODD_COST_FIX, account_finding, odd_cost
from datagen.schemas.checking.finding import Finding, Restore, curable
from datagen.schemas.checking.records import Read, read
from datagen.schemas.ledger import end_key, lost_end, start_from_end, start_key
from datagen.schemas.quarantine import name_before
from datagen.schemas.record_files import encode_record, utc_now
from datagen.schemas.run import Run
from datagen.schemas.run_records import AttemptStart, LedgerEntry, QuarantineRecord, other_value

Ledgered = TypeVar("Ledgered", AttemptStart, LedgerEntry)
_GONE = "Restore the file from a backup; or remove it: its attempt then counts as lost, with unknown cost"


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
            yield Finding(file.key, "foreign", "is not a record of the ledger", "Move it out of the run")
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
        yield from (Finding(one.key, "account", one.problem, _GONE) for one in (end, start) if one.problem)
        return
    noted = end.record
    if start.record is None:
        yield account_finding(run.storage, start, start.problem, start_from_end(noted), noted.shard)
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
        yield Finding(start.key, "account", start.problem, _GONE)
    elif start.record.shard in decided:
        totals.without_account += 1
        problem = "missing, but its shard is decided; the cost is unknown"
        cure = Restore(encode_record(lost_end(start.record, utc_now())), is_guess=True)
        yield curable(end_key(attempt), "account", problem, cure, start.record.shard)
    else:
        totals.unfinished += 1


def _read(run: Run, attempt: str, key_of: Callable[[str], str], model: type[Ledgered]) -> Read[Ledgered]:
    return read(run.storage, key_of(attempt), model, lambda record: _misnamed(record.attempt, attempt))


def check_quarantine(run: Run) -> Iterator[Finding]:
    """Check the records of quarantined shards."""
    fix = "Restore the file from a backup; or remove it: the shard is then tried again"
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
            yield Finding(file.key, "record", problem, fix)


def _misnamed(named: str, file: str) -> str:
    return "" if named == file else "is the record of another"

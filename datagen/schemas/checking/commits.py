"""Checks of the records of a committed shard: its commit, the copy of it, its entries in the ledger."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from datagen.schemas.checking.finding import Finding, Restore, curable
from datagen.schemas.checking.records import AnyRecord, Read, compare, read
from datagen.schemas.errors import InputError
from datagen.schemas.keys import commit_copy_key, commit_key
from datagen.schemas.ledger import end_from_commit, end_key, start_from_end, start_key
from datagen.schemas.record_files import decode_record, encode_record
from datagen.schemas.run import Run
from datagen.schemas.run_records import AttemptStart, Commit, Cost, LedgerEntry, foreign_field
from datagen.schemas.storage import Storage, StoredFile

_ROUNDING = 1e-6
_ROUNDING_S = 1e-3  # of clocks
ODD_COST_FIX = "Find out which program wrote it: the record is undamaged"


@dataclass(frozen=True, eq=False)
class CheckedShard:
    """A shard that is or was committed, with its commit where one of the two files is undamaged."""

    shard: int
    commit: Commit | None
    findings: tuple[Finding, ...]


def check_commit(run: Run, shard: int, listed: dict[str, StoredFile]) -> CheckedShard:
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
    fix = "Restore the file from a backup; or remove it, and `datagen resume` makes the shard again"
    if ours.data is None and ours.problem == "missing":
        fix = "Make the shard again with `datagen resume`"
    problem = f"{ours.problem}, and {'there is no copy' if not copies else 'several attempts left copies'}"
    return CheckedShard(shard, None, (Finding(ours.key, "lost", problem, fix, shard),))


def _sound_copies(run: Run, shard: int, listed: dict[str, StoredFile]) -> list[Read[Commit]]:
    """The undamaged copies of commits in the folders of a shard's attempts."""
    found: list[Read[Commit]] = []
    for key in sorted(listed):
        names = key.split("/")
        if len(names) == 4 and names[3] == "commit.json":
            copy = _copy(run, shard, names[2])
            if copy.record is not None:
                found.append(copy)
    return found


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
        noted = end.record
        for field, ours, wanted in (
            ("attempt", noted.attempt, commit.attempt),
            ("shard", noted.shard, shard),
            ("outcome", noted.outcome, "committed"),
            ("cost", noted.cost, commit.cost),
        ):
            if ours != wanted:
                problem = f"{field}: differs from the attempt's commit"
    if problem:
        known = end_from_commit(commit, start.record.started if start.record else "")
        problem = f"{problem}; the commit has it"
        findings.append(account_finding(run.storage, end, problem, known, shard))
    problem = start.problem
    if start.record is not None and (start.record.attempt, start.record.shard) != (commit.attempt, shard):
        problem = "belongs to another attempt"
    if problem:
        known = start_from_end(end_from_commit(commit, end.record.started if end.record else ""))
        findings.append(account_finding(run.storage, start, problem, known, shard))
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


def account_finding(
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

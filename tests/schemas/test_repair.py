"""Repair beside those who are at work: what they wrote since stays, and is told of."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from datagen.schemas.checking import repair
from datagen.schemas.checking.finding import Finding
from datagen.schemas.checking.repair import repair_runs
from datagen.schemas.keys import commit_copy_key, commit_key
from datagen.schemas.record_files import MAX_RECORD_BYTES, encode_record
from datagen.schemas.run_records import Cost, LedgerEntry
from tests.made_runs import make_run, write
from tests.schemas.checked import no_shard_is_bad


def test_a_guess_gives_way_to_the_account_of_whoever_is_still_at_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(tmp_path, 20)
    for name in ("slow", "lost"):
        run.ledger.start(name, 0)
    account = LedgerEntry(attempt="slow", shard=0, outcome="superseded", cost=Cost(wall_s=7, cpu_s=5))
    check = repair.check_runs

    def and_the_driver_goes_on(*arguments: Any) -> Iterator[Finding]:
        for finding in check(*arguments):
            if finding.key == "ledger/slow.json":
                assert run.ledger.end(account)
            yield finding

    monkeypatch.setattr(repair, "check_runs", and_the_driver_goes_on)
    repaired = repair_runs(run.storage, no_shard_is_bad)
    assert (repaired.records, repaired.left) == (["ledger/lost.json"], [])
    assert run.ledger.end_of("slow") == account
    end = run.ledger.end_of("lost")
    assert end is not None and end.outcome == "lost"
    late = account.model_copy(update={"attempt": "lost"})
    assert run.ledger.end(late) and run.ledger.end_of("lost") == late  # it answers after all
    assert not run.ledger.end(late.model_copy(update={"outcome": "failed"}))
    assert run.ledger.end_of("lost") == late


def test_files_that_others_change_meanwhile_are_named(tmp_path: Path) -> None:
    run = make_run(tmp_path, 20)
    for key in ("other.txt", "gone.txt", "same.txt"):
        run.storage.put(key, b"1")
    files = sum(1 for _ in run.storage.list(""))

    def others(done: int, total: int) -> None:
        run.storage.put("other.txt", b"22")
        run.storage.put("new.txt", b"1")
        run.storage.delete(["gone.txt"])

    repaired = repair_runs(run.storage, no_shard_is_bad, 1, others)
    assert repaired.records == [] and sorted(repaired.changed) == ["gone.txt", "other.txt"]
    assert repaired.untouched == files - 2


def test_of_several_copies_the_one_of_the_ledgers_winner_restores_a_commit(tmp_path: Path) -> None:
    run = make_run(tmp_path, 20)
    for name in ("0-first", "z-last"):  # losers that were killed before they removed theirs
        run.storage.put(commit_copy_key(1, name), encode_record(write(run, 1, name)))
    whole = run.storage.get(commit_key(1), MAX_RECORD_BYTES)
    run.storage.delete([commit_key(1)])
    repaired = repair_runs(run.storage, no_shard_is_bad)
    assert (repaired.records, repaired.left) == ([commit_key(1)], [])
    assert run.storage.get(commit_key(1), MAX_RECORD_BYTES) == whole

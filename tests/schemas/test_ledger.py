"""What checks find in the ledger: accounts that do not add up, what is unfinished, what is foreign."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from datagen.schemas.checking.finding import Finding, Restore, SetAside
from datagen.schemas.quarantine import lift_quarantine
from datagen.schemas.record_files import decode_record, end_from_commit, lost_end
from datagen.schemas.run import Run, commit_copy_key, commit_key
from datagen.schemas.run_records import AttemptStart, Cost, LedgerEntry, Outcome, QuarantineRecord
from tests.faults.damage_campaign import fewer_arrays
from tests.made_runs import make_run
from tests.schemas.checked import check, edit, folder_of, found

COST = Cost(wall_s=3.0, cpu_s=2.0)
GIVEN_UP = QuarantineRecord(
    shard=3, seed=0, first_scene=6, scenes=2, attempts=(), causes=(), stacks=(), created=""
)


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    """Runs of few files."""
    with fewer_arrays():
        yield


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """Shard 1 of five is committed."""
    made = make_run(tmp_path / "run", shards=[1])
    edit(tmp_path / "run/ledger/a-1.json", started="then")
    return made


def only(run: Run) -> Finding:
    (finding,), _ = check(folder_of(run))
    return finding


def restored(finding: Finding, model: type[Any]) -> Any:
    assert isinstance(finding.cure, Restore)
    return decode_record(finding.key, finding.cure.data, model)


@pytest.mark.parametrize(
    ("field", "value"),
    [("shard", 0), ("outcome", "failed"), ("cost", COST.model_dump()), ("cost", None)],
)
def test_an_end_that_is_not_its_commits_follows_from_the_commit(run: Run, field: str, value: Any) -> None:
    edit(folder_of(run) / "ledger/a-1.json", **{field: value})
    start = run.ledger.start_of("a-1")
    assert start is not None
    finding = only(run)
    assert (finding.kind, finding.key, finding.shard) == ("account", "ledger/a-1.json", 1)
    assert finding.problem.startswith(f"{field}: differs from the attempt's commit")
    assert restored(finding, LedgerEntry) == end_from_commit(run.commit_of(1), start.started)


@pytest.mark.parametrize("ending", [".json", ".start.json"])
def test_the_only_record_of_another_attempt_is_not_overwritten(run: Run, ending: str) -> None:
    edit(folder_of(run) / f"ledger/a-1{ending}", attempt="x")
    finding = only(run)
    assert (finding.key, finding.cure) == (f"ledger/a-1{ending}", None)
    assert f"Move it to ledger/x{ending}" in finding.fix
    shutil.copy(folder_of(run) / f"ledger/a-1{ending}", folder_of(run) / f"ledger/x{ending}")
    findings, _ = check(folder_of(run))
    assert isinstance(next(f for f in findings if f.key == finding.key).cure, Restore)


def test_a_start_that_is_not_its_commits_follows_from_the_end(run: Run) -> None:
    edit(folder_of(run) / "ledger/a-1.start.json", shard=0)
    finding = only(run)
    assert (finding.key, finding.problem) == ("ledger/a-1.start.json", "belongs to another attempt")
    assert restored(finding, AttemptStart) == AttemptStart(attempt="a-1", shard=1, started="then", host="h")


@pytest.mark.parametrize(
    ("cost", "problem"),
    [
        ({"stage_wall_s": {"draw": 1.0005}}, ""),  # clocks are read one after the other
        ({"stage_wall_s": {"draw": 0.6, "settle": 0.6}}, "stage_wall_s: the stages sum to 1.2 s"),
        ({"stage_cpu_s": {"draw": 1.5}}, "stage_cpu_s: the stages sum to 1.5 s"),
    ],
)
def test_stages_of_a_commit_that_take_longer_than_it(run: Run, cost: dict[str, Any], problem: str) -> None:
    whole = Cost(wall_s=1.0, cpu_s=1.0, **cost).model_dump(mode="json")
    for key in (commit_key(1), commit_copy_key(1, "a-1"), "ledger/a-1.json"):
        edit(folder_of(run) / key, cost=whole)
    findings, _ = check(folder_of(run))
    assert [(f.key, f.cure) for f in findings] == ([(commit_key(1), None)] if problem else [])
    assert all(problem in f.problem for f in findings)


def test_only_records_belong_into_the_ledger(run: Run) -> None:
    run.storage.put("ledger/a-2.json.part", b"what a killed writer left")
    assert found(folder_of(run)) == []
    for key in ("ledger/notes.txt", "ledger/old/a-2.json"):
        run.storage.put(key, b"")
        assert found(folder_of(run)) == [("foreign", key)]
        run.storage.delete([key])


def test_an_end_and_a_start_that_are_both_damaged_are_two_findings(run: Run) -> None:
    keys = ["ledger/x.json", "ledger/x.start.json"]
    for key in keys:
        run.storage.put(key, b"{}")
    findings, _ = check(folder_of(run))
    assert [(f.key, f.kind, f.cure) for f in findings] == [(key, "account", SetAside()) for key in keys]


def test_records_under_the_name_of_another_attempt(run: Run) -> None:
    run.ledger.end(LedgerEntry(attempt="x", shard=0, outcome="failed"))
    for end in ("json", "start.json"):
        (folder_of(run) / f"ledger/x.{end}").rename(folder_of(run) / f"ledger/y.{end}")
    findings, _ = check(folder_of(run))
    assert [f.key for f in findings] == ["ledger/y.json", "ledger/y.start.json"]
    assert {f.problem for f in findings} == {"is the record of another"}


def test_the_books_add_up_what_was_wasted(run: Run) -> None:
    run.ledger.end(LedgerEntry(attempt="x", shard=0, outcome="failed", cost=COST))
    run.ledger.end(LedgerEntry(attempt="y", shard=0, outcome="superseded", cost=COST))
    run.ledger.start("y", 0)
    run.ledger.end(LedgerEntry(attempt="z", shard=0, outcome="lost"))
    run.ledger.start("open", 0)
    findings, checked = check(folder_of(run))
    totals = checked.totals
    assert findings == []
    assert (totals.attempts, totals.without_account, totals.unfinished) == (5, 1, 1)
    assert (totals.committed_wall_s, totals.wasted_wall_s) == (1.0, 6.0)


def test_attempts_without_an_end_are_lost_once_their_shards_are_decided(run: Run) -> None:
    run.quarantine(GIVEN_UP)
    for attempt, shard in (("late", 1), ("hopeless", 3), ("open", 0)):
        run.ledger.start(attempt, shard)
    starts = {start.attempt: start for start in run.ledger.unfinished()}
    findings, checked = check(folder_of(run))
    assert [(f.key, f.shard) for f in findings] == [("ledger/hopeless.json", 3), ("ledger/late.json", 1)]
    for finding in findings:
        assert isinstance(finding.cure, Restore) and finding.cure.is_guess
        entry = restored(finding, LedgerEntry)
        assert entry == lost_end(starts[entry.attempt], entry.ended)
    assert (checked.totals.without_account, checked.totals.unfinished) == (2, 1)


def test_a_shard_that_the_ledger_alone_calls_committed_is_lost(run: Run) -> None:
    told: dict[str, tuple[int, Outcome]]
    told = {"other": (1, "committed"), "x": (2, "failed"), "gone": (0, "committed")}
    for attempt, (shard, outcome) in told.items():
        run.ledger.start(attempt, shard)
        run.ledger.end(LedgerEntry(attempt=attempt, shard=shard, outcome=outcome, cost=COST))
    _, checked = check(folder_of(run))
    assert checked.totals.lost_shards == {0: "gone"}


def test_quarantine_records_that_are_half_written_or_lifted_are_no_damage(run: Run) -> None:
    run.quarantine(GIVEN_UP)
    run.storage.put("quarantine/000004.json.part", b"{")
    assert found(folder_of(run)) == []
    assert lift_quarantine(run) == [3]
    assert found(folder_of(run)) == []

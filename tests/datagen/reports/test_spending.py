"""The sums of a run: ledger = commits + waste exactly; records that contradict each other are counted."""

from __future__ import annotations

from pathlib import Path

import pytest

from datagen import cli
from datagen.reports.spending import QUARANTINED, account_for
from datagen.schemas.record_files import encode_record, end_key
from datagen.schemas.run import Run
from datagen.schemas.run_records import Cost, LedgerEntry, Outcome
from tests.made_runs import attempt, give_up, make_run, write


def end(run: Run, name: str, shard: int, outcome: Outcome, cost: Cost | None, cause: str = "") -> None:
    run.ledger.start(name, shard)
    run.ledger.end(LedgerEntry(attempt=name, shard=shard, outcome=outcome, cost=cost, cause=cause))


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """Three of five shards with waste of every kind: failed, killed, superseded, lost, quarantined."""
    made = make_run(tmp_path / "run", n=50, shards=[0, 1, 2])
    end(made, "b-0", 0, "failed", Cost(wall_s=0.1, cpu_s=0.2), "ValueError: no")
    end(made, "b-1", 1, "crashed", Cost(wall_s=0.7, cpu_s=0.0))
    attempt(made, 2, "b-2")
    end(made, "b-3", 3, "lost", None)
    for k in range(3):
        end(made, f"c-{k}", 4, "failed", Cost(wall_s=1 / 3, cpu_s=1 / 7), "ValueError: never")
    give_up(made, 4, "never", attempts=("c-0", "c-1", "c-2"))
    return made


def test_every_attempt_is_committed_or_one_kind_of_waste(run: Run) -> None:
    spending = account_for([run])
    assert spending.difference_s == {"wall": 0.0, "cpu": 0.0} and spending.contradictions == 0
    assert (spending.labels, spending.scenes, spending.useful.attempts) == (30, 6, 3)
    attempts = {kind: account.attempts for kind, account in spending.waste.items()}
    assert attempts == {"failed": 1, "crashed": 1, "superseded": 1, "lost": 1, QUARANTINED: 3}
    # The CPU time of a killed process is lost with it; its core was taken for as long as it ran.
    assert spending.waste["crashed"].core_s == 0.7
    assert spending.waste["lost"].unknown == 1
    assert spending.causes["ValueError: never"].attempts == 3
    assert spending.useful.wall_s + spending.wasted.wall_s == pytest.approx(3 + 0.1 + 0.7 + 1 + 1)
    assert spending.useful.core_s + spending.wasted.core_s == pytest.approx(3 + 0.2 + 0.7 + 1 + 3 / 7)


def test_the_audit_reports_a_ledger_that_does_not_add_up(
    run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(["audit", run.storage.url]) == 0
    assert "does not add up" not in capsys.readouterr().out
    broken = run.ledger.end_of("a-1")
    assert broken is not None and broken.cost is not None
    cost = broken.cost.model_copy(update={"wall_s": 2.5})
    run.storage.put(end_key("a-1"), encode_record(broken.model_copy(update={"cost": cost})))
    spending = account_for([run])
    assert spending.difference_s == {"wall": 1.5, "cpu": 0.0} and spending.contradictions == 1
    assert cli.run(["audit", run.storage.url]) == 1
    shown = capsys.readouterr().out
    assert shown.startswith("the ledger does not add up: 1 record and 1.5 s differ; `datagen verify")
    assert cli.run(["verify", run.storage.url]) == 1
    assert "ledger/a-1.json" in capsys.readouterr().out


def test_a_missing_end_and_a_missing_commit_are_contradictions(run: Run) -> None:
    run.storage.delete([end_key("a-0"), "commits/000002.json"])
    spending = account_for([Run.open(run.storage)])
    assert spending.contradictions == 2 and spending.difference_s["wall"] == -1.0


class _RunThatGrows(Run):
    """A job commits one more shard after the ledger was listed, and before the commits are."""

    def committed(self) -> set[int]:
        if not (self.storage.folder / "ledger/meanwhile.json").exists():  # type: ignore[operator]
            shard = self.missing()[0]
            commit = write(self, shard, "meanwhile")
            self.ledger.start("meanwhile", shard)
            assert self.commit(commit)
            self.ledger.end(
                LedgerEntry(attempt="meanwhile", shard=shard, outcome="committed", cost=commit.cost)
            )
        return super().committed()


def test_a_shard_that_is_committed_during_an_audit_is_no_waste(tmp_path: Path) -> None:
    made = make_run(tmp_path, n=50, shards=[0, 1, 2])
    spending = account_for([_RunThatGrows(made.storage, made.manifest)])
    assert made.committed() == {0, 1, 2, 3}
    assert spending.waste == {} and spending.useful.attempts == 4 and spending.contradictions == 0

"""The sums of a run: ledger = commits + waste exactly; records that contradict each other are counted."""

from __future__ import annotations

from pathlib import Path

import pytest

from datagen import cli
from datagen.reports.audit import QUARANTINED, account_for
from datagen.schemas.run import Run
from datagen.schemas.run_records import Cost, LedgerEntry, Outcome
from tests.made_runs import attempt, give_up, make_run


def end(run: Run, name: str, shard: int, outcome: Outcome, cost: Cost | None, cause: str = "") -> None:
    if run.ledger.start_of(name) is None:
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
    assert spending.contradictions == 0
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
    end(run, "a-1", 1, "failed", Cost(wall_s=2.5, cpu_s=1.0))  # which has committed
    assert account_for([run]).contradictions == 1
    assert cli.run(["audit", run.storage.url]) == 1
    shown = capsys.readouterr().out
    assert shown.startswith("the ledger does not add up: 1 record of committed attempts; `datagen verify")
    assert cli.run(["verify", run.storage.url]) == 1
    assert "ledger/a-1.json" in capsys.readouterr().out


def test_a_guess_of_another_job_is_no_contradiction_and_costs_nothing(run: Run) -> None:
    wall_s = account_for([run]).wasted.wall_s
    end(run, "a-0", 0, "lost", None)
    spending = account_for([run])
    assert spending.contradictions == 0 and spending.wasted.wall_s == wall_s

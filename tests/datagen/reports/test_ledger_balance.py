"""The sums of a run: ledger = commits + waste exactly, and the record that breaks them is named."""

from __future__ import annotations

from pathlib import Path

import pytest

from datagen import cli
from datagen.reports.ledger_balance import balance
from datagen.reports.spending import QUARANTINED, account_for
from datagen.schemas.record_files import encode_record, end_key, utc_now
from datagen.schemas.run import Run
from datagen.schemas.run_records import Cost, LedgerEntry, Outcome, QuarantineRecord
from tests.made_runs import attempt, make_run


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
    made.quarantine(
        QuarantineRecord(
            shard=4, seed=0, first_scene=8, scenes=2, attempts=("c-0", "c-1", "c-2"), causes=("never",),
            stacks=("",), created=utc_now(),
        )
    )  # fmt: skip
    return made


def test_ledger_is_commits_plus_waste_to_the_last_bit(run: Run) -> None:
    sums = balance([run])
    assert sums.is_exact and sums.difference_s == {"wall": 0.0, "cpu": 0.0}
    assert sums.commits_s == {"wall": 3.0, "cpu": 3.0}
    assert sums.ledger_s["wall"] == pytest.approx(3 + 0.1 + 0.7 + 1 + 1)
    assert sums.waste_s["cpu"] == pytest.approx(0.2 + 1 + 3 / 7)


def test_waste_is_told_apart_by_cause(run: Run) -> None:
    spending = account_for([run])
    attempts = {kind: account.attempts for kind, account in spending.waste.items()}
    assert attempts == {"failed": 1, "crashed": 1, "superseded": 1, "lost": 1, QUARANTINED: 3}
    killed = spending.waste["crashed"]
    # The CPU time of a killed process is lost with it; its core was taken for as long as it ran.
    assert (killed.cpu_s, killed.core_s) == (0.0, 0.7)
    assert spending.waste["lost"].without_account == 1
    assert spending.causes[("failed", "ValueError: never")].attempts == 3


def test_a_broken_record_is_named_by_the_audit(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["audit", run.storage.url]) == 0
    assert "sums differ" not in capsys.readouterr().out
    broken = run.ledger.end_of("a-1")
    assert broken is not None and broken.cost is not None
    cost = broken.cost.model_copy(update={"wall_s": 2.5})
    run.storage.put(end_key("a-1"), encode_record(broken.model_copy(update={"cost": cost})))
    (finding,) = balance([run]).findings
    assert finding.key == f"{run.storage.url}/ledger/a-1.json" and finding.shard == 1
    assert "2.5 s wall" in finding.problem and "commits/000001.json" in finding.problem
    assert balance([run]).difference_s == {"wall": 1.5, "cpu": 0.0}
    assert cli.run(["audit", run.storage.url]) == 1
    told = capsys.readouterr().out
    assert told.startswith("sums differ for 1 record") and "ledger/a-1.json" in told
    assert cli.run(["verify", run.storage.url, "--repair"]) == 0
    assert balance([Run.open(run.storage)]).is_exact


def test_missing_and_odd_records_are_named(run: Run) -> None:
    run.storage.delete([end_key("a-0"), "commits/000002.json"])
    end(run, "d-3", 3, "failed", Cost(wall_s=1, cpu_s=1, stage_wall_s={"draw": 4.0}))
    sums = balance([Run.open(run.storage)])
    assert not sums.is_exact
    assert [(Path(f.key).name, f.problem.split(":")[0].split(",")[0]) for f in sums.findings] == [
        ("a-0.json", "missing"),
        ("a-2.json", "outcome"),
        ("d-3.json", "cost.stage_wall_s"),
    ]

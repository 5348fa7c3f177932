"""What status and audit say of runs that are cut, or that grow while they are read."""

from __future__ import annotations

from pathlib import Path

from datagen.reports.label_costs import audit_report
from datagen.reports.run_status import status_report
from datagen.reports.spending import account_for
from datagen.schemas.run import Run
from datagen.schemas.run_records import LedgerEntry
from tests.made_runs import make_run, write


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
    assert spending.waste == {} and spending.useful.attempts == 4 and spending.running == 0


def test_positives_are_counted_among_the_labels_made_not_among_those_wanted(tmp_path: Path) -> None:
    run = make_run(tmp_path, n=1)
    report, costs = status_report(run), audit_report(account_for([run]), "heuristic")
    assert (report["labels"], report["labels_made"]) == (1, 10)
    assert report["positives"] == run.commit_of(0).positives == costs["positives"] <= 10
    assert costs["labels"] == 10

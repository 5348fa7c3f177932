"""Costs by kind of label: what is divided by what, on runs whose costs are set by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.reports.audit import audit_runs
from datagen.reports.label_costs import PAPER_LABELS, Spent, cost_per
from datagen.reports.prices import Prices, read_prices
from datagen.schemas.run import Run
from datagen.schemas.run_records import Cost, LedgerEntry
from datagen.schemas.specification import ScenesFrom
from tests.made_runs import make_run, small_spec

STAGES = {"draw": 0.2, "settle": 0.1, "observe": 0.1, "visibility": 0.5}


def priced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every attempt that `make_run` makes takes 1 s of wall and CPU time, of which these stages have 0.9."""

    def cost(**_: Any) -> Cost:
        return Cost(wall_s=1, cpu_s=1, stage_wall_s=STAGES, stage_cpu_s=STAGES, written_bytes=10**6)

    monkeypatch.setattr("tests.made_runs.Cost", cost)


@pytest.fixture
def prices() -> Prices:
    return read_prices()


def source(report: dict[str, Any]) -> dict[str, Any]:
    (one,) = report["sources"]
    return one


def test_a_cost_is_for_so_many_and_none_for_none(prices: Prices) -> None:
    found = cost_per(Spent(10, 8, 0, 0), {"label": 4, "positive": 0}, prices)
    assert found["positive"] is None
    assert found["label"] == {
        "count": 4, "wall_s": 2.5, "core_s": 2.0, "money": pytest.approx(prices.cost_of(8) / 4)
    }  # fmt: skip


def test_every_kind_of_label_carries_the_whole_cost_with_its_waste(
    tmp_path: Path, prices: Prices, monkeypatch: pytest.MonkeyPatch
) -> None:
    priced(monkeypatch)
    run = make_run(tmp_path / "run", n=50)  # 5 shards of 2 scenes and 10 labels
    run.ledger.start("bad", 0)
    killed = Cost(wall_s=2.5, cpu_s=0)
    run.ledger.end(LedgerEntry(attempt="bad", shard=0, outcome="crashed", cost=killed))
    report = source(audit_runs([run], "grid", prices))
    assert report["spent"]["committed"]["core_s"] == pytest.approx(5)
    assert report["spent"]["waste"]["core_s"] == 2.5  # a killed process: as long as it held its core
    near = report["counts"]["in-range"]
    units = {
        "label": 50, "label_within_reach": near["labels"], "positive": report["positives"],
        "positive_within_reach": near["positives"], "accepted_scene": 10,
    }  # fmt: skip
    for name, count in units.items():
        per = report["cost_per"][name]
        assert (per is None) == (count == 0)
        if per is not None:
            assert per["count"] == count and per["core_s"] == pytest.approx(7.5 / count)
            assert per["money"] * count == pytest.approx(prices.cost_of(7.5, 0, 5 * 10**6))
    projected = report["projections"]["label"]
    assert projected["core_days"] == pytest.approx(7.5 / 50 * PAPER_LABELS / 86400)
    assert report["gpu_s"] is None
    tries = report["scene_tries"]
    assert tries["rejected"] == sum(report["redraws"].values())


def test_borrowed_scenes_count_where_their_run_is_audited(
    tmp_path: Path, prices: Prices, monkeypatch: pytest.MonkeyPatch
) -> None:
    priced(monkeypatch)
    maker = make_run(tmp_path / "maker", n=50)
    spec = small_spec(seed=0, scenes_from=ScenesFrom(spec_hash=maker.manifest.spec_hash))
    borrower = make_run(tmp_path / "borrower", n=20, spec=spec)  # 2 of the 5 shards
    alone = source(audit_runs([borrower], "grid", prices))
    assert not alone["includes_scenes"] and alone["cost_per"]["label"]["core_s"] == pytest.approx(2 / 20)
    both = source(audit_runs([borrower, maker], "grid", prices))
    assert both["includes_scenes"]
    assert both["spent"]["scenes_of_other_runs"]["core_s"] == pytest.approx(2 * 0.4)
    assert both["spent"]["own"]["core_s"] == pytest.approx(7)  # nothing is spent twice
    assert both["cost_per"]["label"]["core_s"] == pytest.approx(7.8 / 70)


def test_a_correct_label_costs_its_label_over_the_accuracy(
    tmp_path: Path, prices: Prices, monkeypatch: pytest.MonkeyPatch
) -> None:
    priced(monkeypatch)
    maker = make_run(tmp_path / "maker", n=50)
    spec = small_spec(seed=1, scenes_from=ScenesFrom(spec_hash=maker.manifest.spec_hash))
    truth = make_run(tmp_path / "truth", n=50, spec=spec)
    report = audit_runs([maker, truth], "grid", prices)
    labels = [np.concatenate([_labels(run, shard) for shard in range(5)]) for run in (maker, truth)]
    accuracy = float((labels[0] == labels[1]).mean())
    said, true = report["correct_labels"]
    assert (said["is_truth"], true["is_truth"]) == (False, True)
    assert said["truth"]["run"] == true["run"] == truth.storage.url
    grid = said["sets"]["grid"]
    assert grid["accuracy"] == pytest.approx(accuracy)
    assert grid["core_s_per_correct_label"] == pytest.approx(5 / (50 * accuracy))
    assert true["sets"]["grid"]["core_s_per_correct_label"] == pytest.approx((5 + 5 * 0.4) / 50)


def _labels(run: Run, shard: int) -> np.ndarray:
    from tests.made_runs import rows_of

    return rows_of(run, shard)[1]["label"]

"""`datagen audit`: what is divided by what, on runs whose costs are set by hand, and what a person reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen import cli
from datagen.reports.audit import audit_runs
from datagen.schemas.run import Run
from datagen.schemas.run_records import Cost, LedgerEntry
from datagen.schemas.specification import ScenesFrom
from tests.made_runs import make_run, rows_of, small_spec
from tests.refusals import refused

STAGES = {"draw": 0.2, "settle": 0.1, "observe": 0.1, "visibility": 0.5}


@pytest.fixture
def priced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every attempt that `make_run` makes takes 1 s of wall and CPU time, of which these stages have 0.9."""

    def cost(**_: Any) -> Cost:
        return Cost(wall_s=1, cpu_s=1, stage_wall_s=STAGES, stage_cpu_s=STAGES, written_bytes=10**6)

    monkeypatch.setattr("tests.made_runs.Cost", cost)


def relabelled(folder: Path, maker: Run, n: int, seed: int = 0) -> Run:
    scenes = ScenesFrom(spec_hash=maker.manifest.spec_hash)
    return make_run(folder, n=n, spec=small_spec(seed=seed, scenes_from=scenes))


@pytest.mark.usefixtures("priced")
def test_labels_of_every_kind_carry_the_whole_cost_with_its_waste(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", n=50)  # 5 shards of 2 scenes and 10 labels
    run.ledger.start("bad", 0)
    killed = Cost(wall_s=2.5, cpu_s=0)
    run.ledger.end(LedgerEntry(attempt="bad", shard=0, outcome="crashed", cost=killed))
    report = audit_runs([run])
    (source,) = report["sources"]
    assert report["is_exact"] and source["total_core_s"] == pytest.approx(7.5)
    assert source["core_s"] == pytest.approx(
        {name: 5 * s for name, s in STAGES.items()}
        | {"other": 0.5, "waste": 2.5, "scenes of other runs": 0, "relabelled files": 0}
    )
    rows = [rows_of(run, shard)[1] for shard in range(5)]
    label, clear, mount_m, reach_m = (
        np.concatenate([each[name] for each in rows])
        for name in ("label", "base_is_clear", "mount_distance_m", "arm_reach_m")
    )
    near = (clear == 1) & (mount_m <= reach_m)
    assert source["counts"] == {
        "label": 50, "label_within_reach": near.sum(), "positive": label.sum(),
        "positive_within_reach": label[near].sum(), "scene": 10,
    }  # fmt: skip
    for name, count in source["counts"].items():
        assert source["core_s_per"][name] == (pytest.approx(7.5 / count) if count else None)
    assert source["core_s_per"]["label"] == pytest.approx(7.5 / 50) and source["stored_bytes"] == 5e6


@pytest.mark.usefixtures("priced")
def test_scenes_of_another_run_are_charged_where_that_run_is_named(tmp_path: Path) -> None:
    maker = make_run(tmp_path / "maker", n=50)
    borrower = relabelled(tmp_path / "borrower", maker, 20)  # 2 of the 5 shards
    (alone,) = audit_runs([borrower])["sources"]
    assert not alone["includes_scenes"] and alone["core_s_per"]["label"] == pytest.approx(2 / 20)
    (both,) = audit_runs([borrower, maker])["sources"]
    # Both are heuristic: the scenes are in the cost of the maker's labels.
    assert both["includes_scenes"] and both["core_s"]["scenes of other runs"] == 0
    assert both["core_s_per"]["label"] == pytest.approx(7.0 / 70)
    scenes = ScenesFrom(spec_hash=maker.manifest.spec_hash)
    plan = make_run(tmp_path / "plan", n=20, spec=small_spec(label_source="plan", scenes_from=scenes))
    of_plan = audit_runs([maker, plan])["sources"][1]
    assert of_plan["core_s"]["scenes of other runs"] == pytest.approx(2 * 0.4)
    assert of_plan["core_s_per"]["label"] == pytest.approx(2.8 / 20)
    other = make_run(tmp_path / "other", n=20, spec=small_spec(seed=9))
    assert audit_runs([maker, other, maker])["agreement"] == []  # other scenes, and a run twice


def test_a_terminal_shows_the_answers_in_a_dozen_lines_and_all_in_25(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    maker = make_run(tmp_path / "maker", n=50)
    run = relabelled(tmp_path / "run", maker, 50, seed=1)
    maker.ledger.start("bad", 0)
    maker.ledger.end(LedgerEntry(attempt="bad", shard=0, outcome="failed", cost=None, cause="ValueError: no"))
    for paths in ([maker.storage.url], [maker.storage.url, run.storage.url]):
        answers = ("labels", "core time of a label", "1 failed of", "ValueError: no")
        assert cli.run(["audit", *paths]) == 0
        short = capsys.readouterr().out
        assert cli.run(["audit", *paths, "--full"]) == 0
        shown = capsys.readouterr().out
        notes = 1 + (len(paths) > 1)  # causes of waste, and agreement
        assert len(short.splitlines()) <= 10 + notes and len(shown.splitlines()) <= 25
        assert all(answer in said for answer in answers for said in (short, shown))
        assert "rejected scenes" in shown
    assert "heuristic equals heuristic for" in short
    assert cli.run(["audit", run.storage.url]) == 0
    assert "add the run that made its scenes" in capsys.readouterr().out
    copy = make_run(tmp_path / "copy", n=10)
    for other in (maker, copy):  # of one specification
        refused(["audit", maker.storage.url, other.storage.url], capsys, "would count twice", "datagen merge")
    empty = make_run(tmp_path / "empty", n=50, shards=[])
    assert cli.run(["audit", empty.storage.url]) == 0
    assert "none of 0" in capsys.readouterr().out

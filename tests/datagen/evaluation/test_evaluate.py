"""`datagen evaluate` over real trials, with checkpoints of tiny models that learned nothing."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from datagen import cli
from datagen.evaluation.methods import EvaluatedMethod
from datagen.evaluation.report import Part, evaluation_report
from datagen.evaluation.runs import candidate_sets_of, open_evaluated_runs
from datagen.evaluation.score_files import ScoreFile
from datagen.schemas.run import Run
from datagen.schemas.shard_files import encode_array
from datagen.schemas.shard_reading import read_committed
from datagen.train.baselines.rules import DistanceBand
from datagen.train.models import build_model
from datagen.train.training.checkpoints import (
    Checkpoint,
    read_checkpoint,
    write_checkpoint,
)
from tests.datagen.evaluation.conftest import SIDE, checkpoint
from tests.datagen.evaluation.made_columns import make_columns
from tests.made_runs import make_run, resign
from tests.sim_extra import needs_sim
from tests.small_runs import arrays_of, json_of

pytestmark = needs_sim

SCENES = 6
CELLS = SIDE * SIDE
QUICK = ("--baselines", "none")
PAPER_NETWORK = {
    "n_points": 64, "centroids": [8, 4], "neighbours": [4, 4], "widths": [[4], [4], [8]], "head": [8],
}  # fmt: skip


@pytest.fixture(scope="module")
def grids(small_benchmark: Path) -> Path:
    return small_benchmark / "grids"


def test_tables_equal_counts_of_the_run(
    grids: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stages = ("stage1", "sim-only", "stage2")
    files = [checkpoint(tmp_path / f"{stage}.pt", stage, seed) for seed, stage in enumerate(stages)]
    report = json_of(capsys, ["evaluate", *files, str(grids), *QUICK])
    stored = arrays_of(grids)
    label, clear = stored["label"] == 1, stored["base_is_clear"]
    (part,) = report["parts"]
    assert part["title"] == "unseen houses" and part["left_out"] == {}
    assert {m["name"]: m["regime"] for m in report["methods"]} == {
        "stage1": "stage1", "sim-only": "sim-only", "stage2": "two-stage",
    }  # fmt: skip
    assert all(len(m["checkpoint"]["sha256"]) == 64 for m in report["methods"])
    counts = {name: (told["count"], told["positives"]) for name, told in part["sets"].items()}
    in_range = clear & (stored["mount_distance_m"] <= stored["arm_reach_m"])
    expected = {"in-range": in_range, "clear": clear, "grid": np.ones(len(label), np.bool_)}
    assert counts == {k: (int(rows.sum()), int(label[rows].sum())) for k, rows in expected.items()}
    regimes = [("stage2", "sim-only"), ("sim-only", "stage1")]
    for told in (*part["sets"].values(), part["grids"]):
        found = [(d["first"], d["second"]) for d in told["comparisons"] if d["kind"] == "regimes"]
        assert list(dict.fromkeys(found)) == regimes
    with_good = {int(s) for s in stored["sample_scene_index"][label]}
    assert part["grids"]["scenes"] == SCENES
    assert part["grids"]["scenes_without_positive"] == SCENES - len(with_good)
    assert report["runs"][0]["parts"][0]["label_source"] == "plan"


def test_a_candidate_set_is_reported_over_the_runs_that_cover_it(grids: Path) -> None:
    (run,) = open_evaluated_runs([str(grids)])
    (spec,) = run.specs
    sampled = {"per_scene": 4, "within": "in-range"}
    near = replace(
        run, specs=(spec.model_copy(update={"candidates": spec.candidates.model_copy(update=sampled)}),)
    )
    assert candidate_sets_of([near, run]) == {"in-range": (0, 1), "clear": (1,), "grid": (1,)}
    assert candidate_sets_of([near]) == {"in-range": (0,)} and (near.cells, run.cells) == (0, CELLS)
    columns = make_columns(np.random.default_rng(0), 40)
    columns = replace(columns, run=np.arange(40) % 2)
    methods = [EvaluatedMethod("random", ScoreFile("random", "", 0.5, True, {}))]
    sets = {"in-range": (0, 1), "clear": (1,)}
    report = evaluation_report({"random": 1.0}, methods, [], [Part("all", columns, sets)], [], {})
    clear = report["parts"][0]["sets"]["clear"]
    assert clear["count"] == (columns.is_clear & (columns.run[columns.scene] == 1)).sum()


def test_the_same_command_gives_the_same_numbers_as_json_and_as_tables(
    grids: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = checkpoint(tmp_path / "c.pt"), tmp_path / "report.json"
    words = ["evaluate", str(grids), file, *QUICK]
    first, second = json_of(capsys, [*words, "--out", str(out)]), json_of(capsys, words)
    assert json.loads(out.read_text()) == first
    for report in (first, second):
        assert all(method.pop("seconds_per_600") > 0 for method in report["methods"])
    assert first == second
    assert cli.run([*words, "--full"]) == 0
    said = capsys.readouterr().out
    accuracy = first["parts"][0]["sets"]["clear"]["methods"]["c"]["accuracy"]
    assert f"{100 * accuracy['value']:.1f} [{100 * accuracy['low']:.1f}, " in said
    for line in ("Table I, in %:", "Table II:", "Table III:", "mAP", "commoner label", "arXiv:2509.11594"):
        assert line in said, line


def test_a_terminal_gets_ten_lines_and_the_paper_speaks_of_its_own_network(
    grids: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The paper's figures are of its baselines and its network, not of every model of the same regime."""
    ours, theirs = (checkpoint(tmp_path / f"{name}.pt", "sim-only") for name in ("ours", "theirs"))
    torch.manual_seed(0)
    network = build_model("paper", PAPER_NETWORK)
    head = replace(read_checkpoint(theirs).head, model="paper", model_config=network.config)
    write_checkpoint(Path(theirs), Checkpoint(head, dict(network.state_dict())))
    words = ["evaluate", str(grids), ours, theirs, "--baselines", "proximity", "--baselines", "threshold"]
    assert cli.run(words) == 0
    short = capsys.readouterr().out
    assert len(short.splitlines()) <= 10
    assert cli.run([*words, "--full"]) == 0
    full = capsys.readouterr().out
    assert len(full.splitlines()) > 3 * len(short.splitlines())
    for said in (short, full):
        rows = {line.split()[0]: line.split() for line in reversed(said.splitlines()) if line[:1].isalpha()}
        assert rows["theirs"][-1] == "79.1" and rows["ours"][-1] == "-", said
        assert rows["proximity"][-1] == "46.9"


def test_houses_that_were_trained_on_are_refused_or_reported_separately(
    grids: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    houses, digests = arrays_of(grids)["house_id"], arrays_of(grids)["object_digest"]
    house, count = str(houses[0]), int((houses == houses[0]).sum())
    assert 0 < count < SCENES
    clean = checkpoint(tmp_path / "clean.pt", "stage1", 1)
    for k, field in enumerate(("house_ids", "val_house_ids")):
        said: dict[str, Any] = {field: (house,)}
        leaky = checkpoint(tmp_path / f"{k}.pt", **said)
        assert cli.run(["evaluate", clean, leaky, str(grids), *QUICK]) == 2
        error = capsys.readouterr().err
        assert f"house_id: {k} ({leaky}) was trained on '{house}'" in error and "--allow-seen-houses" in error
    leaky = checkpoint(tmp_path / "leaky.pt", house_ids=(house,), object_digests=(str(digests[0, 0]),))
    words = ["evaluate", leaky, str(grids), *QUICK, "--allow-seen-houses"]
    report = json_of(capsys, words)
    assert [(part["title"], part["scenes"]) for part in report["parts"]] == [
        ("unseen houses", SCENES - count), ("training houses", count),
    ]  # fmt: skip
    label = arrays_of(grids)["label"].reshape(SCENES, CELLS)
    for part, scenes in zip(report["parts"], (houses != house, houses == house), strict=True):
        if label[scenes].any():
            assert part["sets"]["grid"]["count"] == CELLS * int(scenes.sum())
        else:
            assert {"grid", "whole grids"} <= part["left_out"].keys() and part["grids"] is None


def test_baselines_are_fitted_only_in_other_houses(
    grids: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["evaluate", str(grids)]
    report = json_of(capsys, words)
    names = [method["name"] for method in report["methods"]]
    assert names == [
        "proximity",
        "reach-share",
        "threshold",
        "threshold-visibility",
        "analytic",
        "reachability",
    ]
    assert set(report["left_out"]) == {"distance", "scalars"}
    assert all("--fit" in why for why in report["left_out"].values())
    stored = arrays_of(grids)
    feasible = stored["base_is_clear"] & (stored["mount_distance_m"] <= stored["arm_reach_m"])
    told = report["parts"][0]["sets"]["grid"]["methods"]
    right = (feasible == (stored["label"] == 1)).mean()
    assert told["threshold"]["accuracy"]["value"] == pytest.approx(right)
    assert report["methods"][0]["threshold"] is None
    assert {d["kind"] for d in report["parts"][0]["sets"]["grid"]["comparisons"]} == {"other"}
    assert cli.run([*words, "--fit", str(grids)]) == 2
    assert "is also in the training data" in capsys.readouterr().err
    rule = tmp_path / "rule.toml"
    rule.write_text("[heuristic]\nmu = 0.5\ntau = 0.4\n")
    chosen = ["--baselines", "distance", "--baselines", "analytic", "--heuristic", str(rule)]
    report = json_of(capsys, [*words, "--fit", str(grids), "--allow-seen-houses", *chosen])
    assert [part["title"] for part in report["parts"]] == ["training houses"]
    distance, analytic = report["methods"]
    rule.write_text(f"# run {report['runs'][0]['parts'][0]['spec_hash']}: sim\n[heuristic]\nmu = 0.5\n")
    assert cli.run([*words, "--baselines", "analytic", "--heuristic", str(rule)]) == 2
    assert "was fitted on the labels of" in capsys.readouterr().err
    assert distance["state"] and analytic["state"]["params"]["mu"] == 0.5 and analytic["threshold"] < 0.45


def test_baselines_are_fitted_to_what_most_draws_call_good(
    grids: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(grids, tmp_path / "val")
    run = Run.open(tmp_path / "val")
    (field,) = (f for f in run.schema.sample_fields if f.name == "successes")
    for commit in list(run.commits()):  # most draws contradict each label
        most = 3 * (1 - read_committed(run, commit, ["label"])["label"].astype(np.int16))
        resign(run, commit.attempt, encode_array(run.schema, run.layout, "sample", field, most))
    chosen = ["--fit", str(tmp_path / "val"), "--allow-seen-houses", "--baselines", "distance"]
    (distance,) = json_of(capsys, ["evaluate", str(grids), *chosen])["methods"]
    (judged,) = open_evaluated_runs([str(tmp_path / "val")])
    assert distance["state"] == DistanceBand().fit(list(judged.batches())).state()
    assert distance["state"] != DistanceBand().fit(list(judged.stream.epoch(0))).state()


def test_bad_input_is_refused_in_one_line(
    grids: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, run = checkpoint(tmp_path / "c.pt"), str(grids)
    (tmp_path / "thesis.tex").write_text("text")
    odd = tmp_path / "odd.toml"
    odd.write_text('[heuristic]\nmu = "far"\n')
    (rule := tmp_path / "rule.toml").write_text("[heuristic]\nmu = 0.5\n")
    near = grids.parent / "test"
    heuristic, view = make_run(tmp_path / "heuristic").storage.url, str(tmp_path / "view")
    seen_again = ["--scenes-from", run, "--view", "1", "--n", str(SCENES * CELLS), "--out", view]
    assert cli.run(["submit", "plan", *seen_again, "--workers", "0"]) == 0
    cases: list[tuple[list[str], list[str]]] = [
        ([file], ["PATH", "no run is given"]),
        ([file, str(tmp_path / "none")], ["none", "neither a checkpoint file nor a run folder"]),
        ([str(tmp_path / "thesis.tex"), run], ["thesis.tex", "not a datagen checkpoint"]),
        ([file, heuristic], ["label_source: is heuristic", "datagen submit sim"]),
        ([run, "--baselines", "none"], ["PATH", "no model or baseline given"]),
        ([file, file, run], ["METHOD: c: is the name of two methods"]),
        ([file, run, run], ["sample_id", "occurs twice"]),
        ([file, run, view], ["view: scenes: are also in another run", "another viewpoint"]),
        ([file, run, "--baselines", "luck"], ["--baselines: luck: is not a baseline"]),
        ([file, run, "--baselines", "scalars"], ["--baselines: scalars", "--fit"]),
        ([file, run, "--fit", heuristic, "--baselines", "distance"], ["label_source: is heuristic"]),
        ([file, run, "--heuristic", str(tmp_path / "thesis.tex"), *QUICK], ["thesis.tex", "is not TOML"]),
        ([file, run, "--heuristic", str(odd), *QUICK], ["odd.toml: heuristic.mu", "given: far"]),
        ([file, run, "--heuristic", str(rule), *QUICK], ["rule.toml: is for the baseline analytic"]),
        ([file, str(near), "--arrival", "nav2"], ["--arrival: is for picks on whole grids"]),
        ([file, run, "--out", "page.html"], ["--out", "not a .json file"]),
        ([file, run, "--out", str(tmp_path / "no" / "page.json")], ["--out", "folder does not exist"]),
        ([file, run, "--arrival", "ring:1"], ["--arrival: ring:1"]),
        ([file, run, "--execute"], ["--execute: is for --closed-loop"]),
        ([file, run, "--workers", "2"], ["--workers: is for --closed-loop"]),
        ([file, run, "--houses", "builtin"], ["--houses: is for --closed-loop"]),
        ([file, run, "--closed-loop", "0", "--out", "a.json"], ["--closed-loop: 0: is not from 1"]),
    ]
    for words, expected in cases:
        more = [] if "--baselines" in words else ["--baselines", "none"]
        assert cli.run(["evaluate", *words, *more]) == 2, words
        said = capsys.readouterr().err.strip().splitlines()[-1]
        assert said.startswith("error: ") and all(part in said for part in expected), (words, said)

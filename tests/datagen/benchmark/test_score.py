"""`datagen benchmark score` on small planned runs, held against numbers that are computed here."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from datagen import cli
from datagen.train.models import build_model
from datagen.train.training.checkpoints import Checkpoint, CheckpointHead, write_checkpoint
from tests.sim_extra import needs_sim
from tests.small_runs import arrays_of, json_of

pytestmark = needs_sim

TINY = {
    "n_points": 64, "tokens": [4, 4, 4], "scales_m": [0.1], "width": 4, "embedding": 8, "head": [8],
}  # fmt: skip
SCORER = """
import numpy as np

def near(batch):
    assert not batch.label.any() and set(batch.extra) == {"base_is_clear"}
    share = np.linalg.norm(batch.candidates.base_xy_m, axis=1)
    return 1 / (1 + share / batch.robots.arm_reach_m[batch.candidates.robot_row])

def far(batch):
    return np.linalg.norm(batch.candidates.base_xy_m, axis=1)

far.threshold = 0.5

def wrong(batch):
    return far(batch) + 2
"""


def checkpoint(path: Path, **said: Any) -> str:
    torch.manual_seed(0)
    model = build_model("shared", TINY)
    plain: dict[str, Any] = {
        "options": {}, "data": (), "val_data": (), "house_ids": ("elsewhere",), "object_digests": (),
        "val_house_ids": (), "cost": {}, "versions": {}, "history": (),
    }  # fmt: skip
    head = CheckpointHead(model="shared", model_config=model.config, stage="sim-only", **{**plain, **said})
    write_checkpoint(path, Checkpoint(head, dict(model.state_dict())))
    return str(path)


def refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    assert cli.run(["benchmark", "score", *words]) == 2
    told = capsys.readouterr().err.splitlines()
    (line,) = [each for each in told if each.startswith("error: ")]
    return line


@pytest.fixture
def folder_of_mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with the module `mine`."""
    (tmp_path / "mine.py").write_text(SCORER)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    return tmp_path


def test_trainings_that_differ_by_their_seed_have_a_mean(
    scored: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seeds = [
        checkpoint(tmp_path / f"seed{k}.ckpt", options={"seed": k, "lr": 0.1}, cost={"train_cpu_s": k})
        for k in (1, 2)
    ]
    other = checkpoint(tmp_path / "other.ckpt", options={"seed": 3, "lr": 0.2})
    report = json_of(capsys, ["benchmark", "score", *seeds, other, "proximity", *scored])
    assert [m["of"] for m in report["candidates"]["test"]["means"]] == [["seed1", "seed2"]]
    assert [m["of"] for m in report["grids"]["grids"]["mixed"]["means"]] == [["seed1", "seed2"]]
    assert cli.run(["benchmark", "score", *seeds, *scored]) == 0
    told = capsys.readouterr().out
    assert told.count("mean of 2 like seed1") >= 2
    assert "their intervals hold seeds too" in told


def test_every_kind_of_method_has_a_line(
    small_benchmark: Path, scored: list[str], folder_of_mine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, out = checkpoint(folder_of_mine / "tiny.ckpt"), folder_of_mine / "board.json"
    write_near(small_benchmark / "runs", folder_of_mine / "file.csv", "test", "grids")
    words = [model, "mine:near", "file.csv", "mine:far", "proximity", *scored, "--out", str(out)]
    report = json_of(capsys, ["benchmark", "score", *words, "--out", str(folder_of_mine / "board.html")])
    assert json.loads(out.read_text()) == report
    assert "<h2>test: small test; 32 candidates" in (folder_of_mine / "board.html").read_text()
    assert [m["name"] for m in report["methods"]] == ["tiny", "mine:near", "file", "mine:far", "proximity"]
    assert str(folder_of_mine) not in out.read_text()
    told = report["candidates"]["test"]["methods"]
    # The same scores by a function, and by a file that another program wrote.
    for metric in ("balanced_accuracy", "area_under_roc", "accuracy"):
        assert told["mine:near"][metric] == told["file"][metric]
    stored = arrays_of(small_benchmark / "runs" / "test")
    label, far = stored["label"] == 1, stored["distance_m"] >= 0.5
    sides = [(far == label)[label == side].mean() for side in (True, False)]
    assert told["mine:far"]["balanced_accuracy"]["value"] == pytest.approx(np.mean(sides))
    assert told["mine:far"]["expected_calibration_error"] is None
    assert report["candidates"]["test"]["base_rate"] == max(label.mean(), 1 - label.mean())
    assert report["benchmark"]["version"] == "small" and report["benchmark"]["not_scored"] == []


def write_near(runs: Path, out: Path, *names: str) -> None:
    """The scores of `near` for the clear candidates of these runs."""
    lines = ["sample_id,score"]
    for name in names:
        stored = arrays_of(runs / name)
        score = 1 / (1 + stored["distance_m"].astype(np.float64) / stored["arm_reach_m"])
        rows = np.flatnonzero(stored["base_is_clear"])
        lines += [f"{stored['sample_id'][row].tobytes().hex()},{score[row]:.6f}" for row in rows]
    out.write_text("\n".join(lines) + "\n")


def test_grids_are_those_with_good_and_bad_cells(
    small_benchmark: Path, scored: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["benchmark", "score", "proximity", *scored, "--run", "grids"]
    report = json_of(capsys, words)
    stored = arrays_of(small_benchmark / "runs" / "grids")
    scenes = stored["sample_scene_index"]
    clear, good = stored["base_is_clear"], stored["label"] == 1
    counts = [(clear[scenes == s].sum(), (clear & good)[scenes == s].sum()) for s in np.unique(scenes)]
    mixed = [share for share in (g / c for c, g in counts if c) if 0 < share < 1]
    told = report["grids"]["grids"]
    assert mixed and told["mixed"]["scenes"] == len(mixed)
    hard = sum(share <= 0.2 for share in mixed)
    assert (told["hard"] or {"scenes": 0})["scenes"] == hard
    arrivals = told["mixed"]["arrivals"]
    assert len(arrivals) == 6 and set(arrivals[0]["methods"]["proximity"]) == {"nominal", "smoothed"}
    assert arrivals[0]["best"] == 1.0 >= arrivals[-1]["best"]
    assert report["candidates"] == {} and report["benchmark"]["not_scored"] == ["test"]
    assert cli.run(words) == 0
    assert "not scored" in capsys.readouterr().out


def test_a_run_that_differs_is_refused_with_what_differs(
    small_benchmark: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    definition = json.loads((small_benchmark / "benchmark.json").read_text())
    runs = str(small_benchmark / "runs")
    for path, value, told in (
        (("spec", "seed"), 7, "seed is 0, but 7 in run test of benchmark small"),
        (("spec", "candidates", "mast_radius_m"), 0.07, "candidates.mast_radius_m"),
        (("n",), 36, "labels: are 32, but 36"),
        (("digests", "labels"), "0" * 64, "labels have the digest"),
        (("digests", "candidates"), "0" * 64, "candidates have the digest"),
    ):
        changed = json.loads(json.dumps(definition))
        section = changed["runs"]["test"]
        for key in path[:-1]:
            section = section[key]
        section[path[-1]] = value
        (tmp_path / "other.json").write_text(json.dumps(changed))
        words = ["proximity", "--runs", runs, "--benchmark", str(tmp_path / "other.json")]
        assert told in refused(words, capsys)


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ({"object": True}, "was trained on 1 of the"),
        ({"house": True}, "was trained on it. Train it on runs of the splits train and val alone"),
    ],
)
def test_models_that_saw_what_is_held_out_are_refused(
    small_benchmark: Path,
    tmp_path: Path,
    said: dict[str, bool],
    told: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    definition = json.loads((small_benchmark / "benchmark.json").read_text())
    definition["runs"]["test"]["objects"] = "test"
    (tmp_path / "held-out.json").write_text(json.dumps(definition))
    stored = arrays_of(small_benchmark / "runs" / "test")
    trained: dict[str, Any] = {}
    if "object" in said:
        trained["object_digests"] = (str(stored["object_digest"][0, 0]),)
    else:
        trained["house_ids"] = (str(stored["house_id"][0]),)
    model = checkpoint(tmp_path / "model.ckpt", **trained)
    runs = ["--runs", str(small_benchmark / "runs"), "--benchmark", str(tmp_path / "held-out.json")]
    assert told in refused([model, *runs], capsys)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "line 1: is not sample_id,score"),
        ("id,score\n", "line 1: is not sample_id,score"),
        ("sample_id,score\n", "sample_id: has no score for "),
        ("sample_id,score\nab,1\n", "line 2: is not an id of 32 hexadecimal digits and a score"),
        (f"sample_id,score\n{'0' * 32},x\n", "line 2: score 'x' is not a finite number"),
        (f"sample_id,score\n{'0' * 32},nan\n", "line 2: score 'nan' is not a finite number"),
        (f"sample_id,score\n{'0' * 32},1\n{'0' * 32},1\n", "line 3: scores 0000"),
        (f"# threshold: y\nsample_id,score\n{'0' * 32},1\n", "line 1: threshold 'y' is not"),
        (f"sample_id,score\n{'0' * 32},7\n", "is no probability, and no threshold is stated"),
        ("sample_id,score\n\x00", "line 2: is not an id"),
        ("\xff", "is not UTF-8 text"),
    ],
)
def test_a_broken_file_of_scores_is_one_line(
    text: str, told: str, scored: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.csv").write_bytes(text.encode("latin-1"))
    line = refused([str(tmp_path / "mine.csv"), *scored], capsys)
    assert f"{tmp_path}/mine.csv: {told}" in line or told in line


@pytest.mark.parametrize(
    ("method", "told"),
    [
        ("nothing.ckpt", "METHOD: nothing.ckpt: is no file and no baseline. Give released"),
        ("nowhere:score", "there is no module nowhere"),
        ("json:nothing", "json has no function nothing"),
        ("mine:wrong", "score: is no probability, and no threshold is stated"),
        ("scalars", "needs runs to fit its parameters on"),
    ],
)
def test_a_method_that_is_none_is_one_line(
    method: str, told: str, scored: list[str], folder_of_mine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert told in refused([method, *scored], capsys)


def test_a_file_states_its_threshold(
    small_benchmark: Path, scored: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = small_benchmark / "runs"
    write_near(runs, tmp_path / "low.csv", "test")
    text = (tmp_path / "low.csv").read_text()
    scores = np.array([float(line.split(",")[1]) for line in text.splitlines()[1:]])
    threshold = float(np.median(scores))
    (tmp_path / "high.csv").write_text(f"# threshold: {threshold}\n{text}")
    words = [str(tmp_path / "low.csv"), str(tmp_path / "high.csv"), *scored, "--run", "test"]
    report = json_of(capsys, ["benchmark", "score", *words])
    told = report["candidates"]["test"]["methods"]
    assert told["low"]["area_under_roc"] == told["high"]["area_under_roc"]
    label = arrays_of(runs / "test")["label"] == 1  # all of them are clear and within reach
    expected = np.mean([((scores >= threshold) == label)[label == side].mean() for side in (True, False)])
    assert told["high"]["balanced_accuracy"]["value"] == pytest.approx(expected)
    assert told["high"]["expected_calibration_error"] is None
    assert [m["threshold"] for m in report["methods"]] == [0.5, threshold]


def test_the_lines_of_the_card_need_nothing_of_this_project(
    small_benchmark: Path, scored: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = Path(__file__).parents[3] / "docs" / "results" / "benchmark.md"
    (code,) = [
        block.split("```")[0] for block in page.read_text().split("```python\n")[1:] if "zarr" in block
    ]
    assert len(code.strip().splitlines()) <= 12
    code = code.replace('("test", "test-known", "trials", "grids")', '("test", "grids")')
    (tmp_path / "runs").symlink_to(small_benchmark / "runs")
    alone = "import sys; sys.modules['datagen'] = None\n" + code
    subprocess.run([sys.executable, "-I", "-c", alone], cwd=tmp_path, check=True)
    report = json_of(capsys, ["benchmark", "score", str(tmp_path / "mine.csv"), *scored])
    assert report["candidates"]["test"]["methods"]["mine"]["area_under_roc"]["value"] > 0

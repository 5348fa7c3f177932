"""The model that ships with the package is what its card says, and answers right after installation."""

from __future__ import annotations

import hashlib
import json
import math
import re
import runpy
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import datagen
from datagen import cli, released
from datagen.evaluation.benchmark import read_benchmark
from datagen.evaluation.methods import open_models
from datagen.schemas.specification import PLACE_KINDS
from datagen.train.program_scorer import read_program
from datagen.train.scorers import weights_sha256
from datagen.train.training.checkpoints import load_model, read_checkpoint
from datagen.workers.robots import robot_limits
from scripts.release_model import card_text
from tests.conftest import REPOSITORY
from tests.refusals import refused
from tests.sim_extra import needs_sim
from tests.small_runs import json_of
from tests.train.prediction.checkpoints import write_untrained
from tests.train.prediction.seen_scenes import MODEL

FOLDER = released.FOLDER


def content(name: str) -> dict[str, Any]:
    return json.loads((FOLDER / name).read_bytes())


def test_the_file_the_benchmark_and_the_page_are_those_of_the_card() -> None:
    card, path = content(released.CARD), released.released_checkpoint()
    data = path.read_bytes()
    assert len(data) == card["bytes"] < 5_000_000
    assert hashlib.sha256(data).hexdigest() == card["sha256"]
    assert weights_sha256(load_model(path)[0]) == card["weights_sha256"]
    assert datagen.load_scorer().program.facts["weights_sha256"] == card["weights_sha256"]
    checkpoint = read_checkpoint(path)
    head = checkpoint.head
    assert not checkpoint.resume  # nothing of the optimiser
    assert (head.model, head.model_config, head.stage) == (card["model"], card["config"], card["stage"])
    assert (len(head.house_ids), len(head.object_digests)) == (card["houses"], card["objects"])
    assert [dict(each) for each in head.data] == card["data"]
    shipped = read_benchmark()
    assert card["benchmark"] == {"version": shipped.version, "digest": shipped.digest()}
    runs = [name for name, run in shipped.runs.items() if run.is_of_grids]
    assert set(card["metrics"]) == {
        *shipped.runs, *(f"{run}, decisive" for run in runs), *(f"grids, {kind}" for kind in PLACE_KINDS)
    }  # fmt: skip
    page = card_text(card, (FOLDER / released.RECIPE).read_text("utf-8"))
    assert page == (FOLDER / released.CARD_PAGE).read_text("utf-8")


def test_no_file_names_a_folder_of_a_machine_and_the_sample_frame_names_its_sources() -> None:
    for path in FOLDER.rglob("*"):
        if path.is_file() and path.suffix in (".json", ".md", ".safetensors"):
            text = path.read_bytes()
            if path.suffix == ".safetensors":
                text = text[8 : 8 + int.from_bytes(text[:8], "little")]  # its JSON header
            assert not re.search(rb"(?<![\w.:/>-])/[\w.-]+/", text), path

    frame = released.sample_frame()
    assert sum(path.stat().st_size for path in frame.iterdir()) < 400_000
    told = (frame / "ATTRIBUTION.md").read_text("utf-8")
    assert all(each in told for each in ("Apache License 2.0", "Creative Commons Attribution 4.0", "YCB"))
    assert Image.open(frame / "color.png").size == Image.open(frame / "depth.png").size == (640, 480)


def test_the_demonstration_answers_what_the_card_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.run(["predict", "--demo", "--export", "my frame"]) == 0
    out = capsys.readouterr().out
    assert "base poses by the released model" in out and "demo.png" in out and "demo.html" in out
    assert Image.open(tmp_path / "demo.png").size[0] > 500
    assert b"<html" in (tmp_path / "demo.html").read_bytes()[:200]
    said = content(released.CARD)["demo"]
    answer = json_of(capsys, ["predict", "--demo"])["best"]
    assert np.allclose([answer["x_m"], answer["y_m"]], said["base_xy_m"], atol=1e-3)
    assert math.isclose(answer["score"], said["score"], abs_tol=1e-3)
    again = shlex.split(out.split("again: ")[1])[1:]
    assert again[:5] == ["predict", "--frame", "my frame", "--map", "my frame/map.yaml"]
    assert json_of(capsys, again)["best"] == answer and (tmp_path / "answer.png").is_file()
    refused(["predict", "--demo", "--export", "my frame"], capsys)


@needs_sim
def test_the_demonstration_is_also_of_other_robots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    answer = json_of(capsys, ["predict", "--demo", "--robot", "fetch"])
    limits = robot_limits("fetch")
    assert limits.base_height_m is not None
    sizes = [answer["robot"][name] for name in ("arm_reach_m", "base_height_m")]
    assert sizes == pytest.approx([limits.reach_m[0], limits.base_height_m[0]])
    cli.run(["predict", "--demo", "--robot", "fetch"])
    words = shlex.split(capsys.readouterr().out.split("again: ")[1])[1:]
    assert json_of(capsys, words)["candidates"] == answer["candidates"]


def test_the_command_of_the_demonstration_keeps_the_options_that_decide_its_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_untrained(tmp_path / "own.ckpt", MODEL)
    given = ["predict", "own.ckpt", "--demo", "--allow-unseen", "--footprint", "0.4", "--arrival", "nav2"]
    answer = json_of(capsys, given)
    cli.run(given)
    words = shlex.split(capsys.readouterr().out.split("again: ")[1])[1:]
    again = json_of(capsys, words)
    assert again["scorer"] == answer["scorer"] and again["candidates"] == answer["candidates"]


def test_a_frame_without_a_checkpoint_is_scored_by_the_released_model(
    capsys: pytest.CaptureFixture[str],
) -> None:
    frame = ["--frame", str(released.sample_frame())]
    robot = ["--base-height", "0.7", "--reach", "0.9"]
    first = json_of(capsys, ["predict", *frame, *robot])
    assert first["scorer"].startswith("the released model, ")
    assert json_of(capsys, ["predict", "released", *frame, *robot]) == first


def test_it_has_its_own_name_beside_other_models(tmp_path: Path) -> None:
    write_untrained(tmp_path / "other.ckpt", MODEL)
    found = open_models([str(released.released_checkpoint()), str(tmp_path / "other.ckpt")])
    assert [method.name for method in found] == ["released", "other"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--demo", "--click", "1,2"], "has a frame and a click of its own"),
        (["--demo", "--frame", "x"], "has a frame and a click of its own"),
        (["--frame", "x"], "--base-height: is missing"),
        (["--frame", "x", "--base-height", "0.7"], "--reach: is missing"),
        (["--frame", "x", "--export", "y"], "is given without --demo or --bag"),
        (["--demo", "--export", "a.png", "--out", "a.png"], "Give another name"),
        (["--demo", "--out", "none/a.png"], "its folder does not exist"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(
    words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert told in refused(["predict", *words], capsys)


def test_releasing_another_model_writes_file_and_card(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "released"
    shutil.copytree(FOLDER, copy)
    monkeypatch.setattr(released, "FOLDER", copy)
    write_untrained(tmp_path / "model.ckpt", MODEL | {"kinematics": True})
    scorer = datagen.load_scorer(tmp_path / "model.ckpt")
    value = {"value": 0.5, "low": 0.4, "high": 0.6}
    metrics = dict.fromkeys(("accuracy", "balanced_accuracy", "area_under_roc"), value)
    metrics |= {"expected_calibration_error": 0.1, "brier": 0.2}
    scores = {"count": 9, "scenes": 3, "methods": {"model": metrics}}
    board: dict[str, Any] = {
        "benchmark": {"version": "2", "digest": "0" * 64},
        "methods": [{"name": "model", "checkpoint": {"weights_sha256": ""}}],
        "parts": [{"title": "test", "sets": {"in-range": scores}, "grids": None}],
    }
    script = str(REPOSITORY / "scripts" / "release_model.py")

    def release() -> int:
        (tmp_path / "board.json").write_text(json.dumps(board))
        monkeypatch.setattr(sys, "argv", ["", str(tmp_path / "model.ckpt"), str(tmp_path / "board.json")])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(script, run_name="__main__")
        assert isinstance(ended.value.code, int)
        return ended.value.code

    assert release() == 2
    assert "has no line of the weights" in capsys.readouterr().err
    assert (copy / released.CHECKPOINT).read_bytes() == (FOLDER / released.CHECKPOINT).read_bytes()
    board["methods"][0]["checkpoint"]["weights_sha256"] = weights_sha256(scorer.model)
    assert release() == 0
    card = json.loads((copy / released.CARD).read_bytes())
    assert card["weights_sha256"] == weights_sha256(scorer.model)
    assert card["bytes"] == (copy / released.CHECKPOINT).stat().st_size
    assert read_program(copy / released.PROGRAM).facts["weights_sha256"] == card["weights_sha256"]
    assert card["sha256"][:12] in (copy / released.CARD_PAGE).read_text()
    assert card["metrics"]["test"]["balanced_accuracy"] == value

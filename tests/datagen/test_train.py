"""`datagen train` as a user calls it: stages, refusals, and Ctrl-C."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from datagen import cli
from datagen.commands.train import model_sizes
from datagen.released import released_checkpoint
from datagen.schemas.errors import InputError
from datagen.train.splits import split_by_house
from datagen.train.training.checkpoints import load_model, read_checkpoint, write_checkpoint
from datagen.train.training.training_setup import choose_device
from tests.refusals import refused
from tests.sim_extra import needs_sim
from tests.small_runs import json_of, make_small_run
from tests.train.conftest import heuristic_run, sim_run
from tests.train.training.small import TINY, equal

__all__ = ["heuristic_run", "sim_run"]
HERE = ("--threads", "1", "--device", "cpu")


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A file of the tiny model's sizes."""
    path = tmp_path_factory.mktemp("model") / "tiny.toml"
    path.write_text("".join(f"{name} = {value}\n" for name, value in TINY.items()))
    return str(path)


def words(stage: str, run: Path, out: Path, *more: str) -> list[str]:
    return ["train", stage, str(run), "--out", str(out), *HERE, *more]


@pytest.fixture(scope="module")
def first(heuristic_run: Path, tiny: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished stage 1 of one epoch."""
    out = tmp_path_factory.mktemp("first") / "one.ckpt"
    assert cli.run(words("stage1", heuristic_run, out, "--epochs", "1", "--model-config", tiny)) == 0
    return out


@needs_sim
def test_both_stages_from_the_command_line(
    first: Path, sim_run: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    out = tmp_path / "two.ckpt"
    more = ("--init", str(first), "--epochs", "2")
    arguments = words("stage2", sim_run, out, *more)
    capfd.readouterr()
    assert cli.run([*arguments, "--json"]) == 0
    told = capfd.readouterr()
    report = json.loads(told.out)
    lines = [json.loads(line) for line in told.err.splitlines()]
    model, head = load_model(out)
    began = read_checkpoint(first).head
    assert report["end"] == "finished"
    assert report["digest"] == head.digest
    assert [line["epoch"] for line in lines if line["event"] == "epoch"] == [1, 2]
    assert report["history"] == list(head.history)
    assert report["best"] == head.history[(head.best_epoch or 0) - 1]
    assert head.stage == "stage2"
    assert head.init == {"digest": began.digest, "stage": "stage1", "cost": began.cost}
    assert set(began.house_ids) <= set(head.house_ids)
    assert set(began.val_house_ids) <= {*head.house_ids, *head.val_house_ids}
    assert model.config == began.model_config
    assert not set(head.house_ids) & set(head.val_house_ids)
    assert head.options["weight_decay"] == 0.01
    assert [run["schema"] for run in head.data] == ["sim"]
    assert json_of(capfd, arguments)["digest"] == head.digest


def test_a_sealed_store_trains_as_its_run(
    first: Path, heuristic_run: Path, tiny: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    shutil.copytree(heuristic_run / "data.zarr", tmp_path / "data.zarr")
    more = ("--epochs", "1", "--model-config", tiny)
    capsys.readouterr()
    assert cli.run(words("stage1", tmp_path / "data.zarr", tmp_path / "c.ckpt", *more)) == 0
    assert "unknown for labels" in capsys.readouterr().out
    assert equal(read_checkpoint(tmp_path / "c.ckpt").weights, read_checkpoint(first).weights)
    assert cli.run(words("stage1", heuristic_run, first, *more)) == 0
    assert "s of CPU for labels" in capsys.readouterr().out


@needs_sim
def test_runs_that_do_not_fit_the_stage_are_refused(
    first: Path, heuristic_run: Path, sim_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out, is_heuristic = tmp_path / "c.ckpt", "label_source: is heuristic"
    told = (str(sim_run), "label_source: is sim", "trains on", "Use it for stage2 or sim-only")
    refused(words("stage1", sim_run, out), capsys, *told)
    refused(words("sim-only", heuristic_run, out), capsys, is_heuristic, "trains on", "Use it for stage1")
    validation = ("--val", str(heuristic_run))
    refused(words("sim-only", sim_run, out, *validation), capsys, is_heuristic, str(heuristic_run))
    assert not out.exists()


@needs_sim
def test_the_released_model_is_a_start(sim_run: Path, tmp_path: Path) -> None:
    """With a rate of nearly nothing its weights stay."""
    out = tmp_path / "mine.ckpt"
    assert cli.run(words("stage2", sim_run, out, "--init", "released", "--epochs", "1", "--lr", "1e-12")) == 0
    released, mine = read_checkpoint(released_checkpoint()), read_checkpoint(out)
    assert mine.head.init is not None and mine.head.init["digest"] == released.head.digest
    assert mine.head.model_config == released.head.model_config
    assert set(released.head.house_ids) < set(mine.head.house_ids)
    name = next(name for name in released.weights if name.startswith("token"))
    torch.testing.assert_close(mine.weights[name], released.weights[name])


@needs_sim
def test_no_house_that_the_start_was_trained_on_validates(
    first: Path, sim_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """As of `released`, which was trained on all houses of the split `train`, also on a held-out tenth."""
    start, held_out = read_checkpoint(first), sorted(split_by_house([sim_run])[1].house_ids())
    head = replace(start.head, house_ids=(*start.head.house_ids, *held_out))
    write_checkpoint(tmp_path / "all.ckpt", replace(start, head=head))
    arguments = words("stage2", sim_run, tmp_path / "c.ckpt", "--init", str(tmp_path / "all.ckpt"))
    refused(arguments, capsys, "all.ckpt", f"'{held_out[0]}'", "training data of --init", "--split val")


def test_what_cannot_be_trained_is_refused(
    first: Path, heuristic_run: Path, tiny: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out, run = tmp_path / "c.ckpt", heuristic_run
    cases: list[tuple[list[str], tuple[str, ...]]] = [
        (words("stage2", run, out), ("--init", "stage2 starts from a checkpoint", "released")),
        (words("stage1", run, out, "--init", str(first)), ("--init", "random weights")),
        (words("stage2", run, out, "--init", tiny), (tiny, "checkpoint")),
        (words("stage1", tmp_path / "none", out), ("none",)),
        (words("stage1", run, out, "--val", str(run)), ("house",)),
        (words("stage1", run, out, "--epochs", "0"), ("--epochs",)),
        (words("stage1", run, out, "--lr", "nan"), ("--lr",)),
        *((words("stage1", run, out, "--house-share", s), ("--house-share",)) for s in ("0", "1.5", "nan")),
        (words("stage1", run, out, "--model-config", "width=x"), ("width",)),
        (words("stage1", run, out, "--model-config", "beauty=1"), ("beauty",)),
        (words("stage1", run, out, "--model-config", "none.toml"), ("none.toml",)),
        (words("stage1", run, out, "--threads", "0"), ("--threads",)),
        (["train", "stage1", str(run), "--out", "s3://b/m.ckpt", *HERE], ("--out", "is an address")),
        (words("stage1", run, out, "--encoded", "s3://b/inputs"), ("--encoded", "is an address")),
        (words("stage1", run, tmp_path), (str(tmp_path), "not a file")),
    ]
    for arguments, told in cases:
        refused(arguments, capsys, *told)
    assert not out.exists()


def test_another_training_is_not_overwritten(
    first: Path, heuristic_run: Path, tiny: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    before = first.read_bytes()
    more = ("--model-config", tiny, "--epochs", "2", "--seed", "5")
    told = refused(words("stage1", heuristic_run, first, *more), capsys, str(first), "epochs (1, now 2)")
    assert "seed (0, now 5)" in told
    assert "house_share" not in told
    refused(words("stage1", heuristic_run, Path(more[1]), *more), capsys, "not a datagen checkpoint")
    # A run more, after one whose digest is longer than what the error shows.
    other = make_small_run(tmp_path / "other", 64, "--seed", "9")
    same = "--epochs", "1", "--model-config", tiny
    refused(
        ["train", "stage1", str(heuristic_run), str(other), "--out", str(first), *HERE, *same],
        capsys,
        "data (",
    )
    assert first.read_bytes() == before


def test_a_model_of_ones_own_is_found_by_the_name_that_was_given(
    heuristic_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "own_models.py").write_text(
        "from datagen.train.models.shared import SharedModel\n\n\n"
        "class Own(SharedModel):\n    name = 'mine'\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("DATAGEN_ALLOW", "own_models:Own")
    out = tmp_path / "own.ckpt"
    assert cli.run(words("stage1", heuristic_run, out, "--epochs", "1", "--model", "own_models:Own")) == 0
    assert type(load_model(out)[0]).__name__ == "Own"


def test_ctrl_c_loses_nothing(heuristic_run: Path, tiny: str, tmp_path: Path):
    """A real interrupt of a real process; what goes on from there ends as what nobody interrupted."""
    more = ("--model-config", tiny, "--epochs", "3")
    arguments = words("stage1", heuristic_run, tmp_path / "c.ckpt", *more)
    program = "import sys; from datagen.cli import main; main()"
    process = subprocess.Popen([sys.executable, "-c", program, *arguments], stderr=subprocess.PIPE, text=True)
    while not (tmp_path / "c.ckpt").exists() and process.poll() is None:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    told = process.communicate()[1]
    if process.returncode == 130:  # unless it had come to its end just then
        assert f"Resume with:\n  datagen train stage1 {heuristic_run} --out {tmp_path / 'c.ckpt'}" in told
        assert not read_checkpoint(tmp_path / "c.ckpt").head.finished
    else:
        assert process.returncode == 0
    assert cli.run(arguments) == 0
    assert cli.run(words("stage1", heuristic_run, tmp_path / "whole.ckpt", *more)) == 0
    one, other = (read_checkpoint(tmp_path / name) for name in ("c.ckpt", "whole.ckpt"))
    assert equal(one.resume, other.resume)
    assert one.head.history == other.head.history


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_a_gpu_that_is_not_there_is_refused():
    with pytest.raises(InputError, match="torch finds no GPU"):
        choose_device("cuda")
    assert choose_device("auto") == "cpu"


def test_sizes_of_a_model(tiny: str):
    asked = model_sizes([tiny, "width=16", "scales_m=[0.1, 0.2]", "camera=unknown"])
    assert asked == {**TINY, "width": 16, "scales_m": [0.1, 0.2], "camera": "unknown"}

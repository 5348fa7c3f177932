"""Heuristic labels need no extra; what needs one says in a line what is missing and how to install it."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.sim_extra import needs_sim
from tests.small_runs import PER_SCENE, submit_arguments
from tests.train.conftest import sim_run
from tests.train.prediction.checkpoints import write_untrained
from tests.train.prediction.seen_scenes import draw_seen, write_frame

__all__ = ["sim_run"]

# As if none of these were installed.
WITHOUT = """
import contextlib
import io
import json
import sys
from importlib.machinery import PathFinder

missing, commands = json.loads(sys.argv[1])
find_spec = PathFinder.find_spec
PathFinder.find_spec = lambda name, *rest: None if name.split(".")[0] in missing else find_spec(name, *rest)

from datagen import cli

done = []
for words in commands:
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        code = cli.run(words)
    done.append([code, out.getvalue(), err.getvalue()])
print(json.dumps(done))
"""


SIM = ("pinocchio", "coal", "ompl", "mani_skill", "mplib", "gymnasium", "h5py", "torch")


@dataclass(frozen=True)
class Told:
    """How a command ended and what it said."""

    returncode: int
    stdout: str
    stderr: str


def datagen_without(missing: Sequence[str], *commands: list[str]) -> list[Told]:
    """These commands one after another in one process."""
    command = [sys.executable, "-c", WITHOUT, json.dumps([missing, commands])]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    return [Told(*one) for one in json.loads(done.stdout)]


def refused_line(told: Told) -> str:
    """The one line of a command that was refused."""
    assert told.returncode == 2, told.stderr
    assert told.stdout == "" and told.stderr.count("\n") == 1 and told.stderr.startswith("error: ")
    return told.stderr


def test_heuristic_labels_need_no_extra_and_others_name_it_in_one_line(
    tmp_path: Path,
) -> None:
    run, picture = tmp_path / "run", tmp_path / "scene.png"
    show = ["show", str(run), "--scene", "0", "--out", str(picture)]
    other = [
        ["submit", source, "--n", "60", "--out", str(tmp_path / "other"), "--workers", "0"]
        for source in ("plan", "sim")
    ]
    audit = ["audit", str(run), "--json"]
    *made, plan, sim = datagen_without(SIM, submit_arguments(run, PER_SCENE), show, audit, *other)
    for done in made:
        assert done.returncode == 0, done.stderr
    assert picture.is_file()
    assert json.loads(made[-1].stdout)["sources"]
    for told in (plan, sim):
        assert "Install the extra sim: pip install" in refused_line(told)
    assert not (tmp_path / "other").exists()


def test_training_and_prediction_name_torch_in_one_line(finished: Path, tmp_path: Path) -> None:
    checkpoint, out = tmp_path / "model.ckpt", tmp_path / "new.ckpt"
    write_untrained(checkpoint, {})
    write_frame(tmp_path / "frame", draw_seen(0))
    robot = ["--base-height", "0.7", "--reach", "0.9", "--camera-height", "0.8"]
    predict = ["predict", str(checkpoint), "--frame", str(tmp_path / "frame"), *robot]
    train = ["train", "stage1", str(finished), "--out", str(out)]
    for told in datagen_without(["torch"], train, [*predict, "--json"]):
        line = refused_line(told)
        assert "torch: is not installed. Install the extra train: pip install" in line
        assert " datagen[" not in line and not out.exists()
    page = [*predict, "--html", str(tmp_path / "page.html"), "--out", str(tmp_path / "a.png")]
    (told,) = datagen_without(["plotly"], page)
    line = refused_line(told)
    assert "plotly: is not installed. Install the extra train: pip install" in line
    assert not (tmp_path / "a.png").exists()


@needs_sim
def test_evaluation_names_torch_in_one_line(sim_run: Path, tmp_path: Path) -> None:
    write_untrained(tmp_path / "model.ckpt", {})
    command = ["evaluate", str(tmp_path / "model.ckpt"), str(sim_run), "--json"]
    (told,) = datagen_without(["torch"], command)
    line = refused_line(told)
    assert "torch: is not installed. Install the extra train: pip install" in line

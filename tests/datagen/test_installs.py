"""The wheel with just those libraries that it asks for: what each extra does, and what is said of others."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import pytest

from datagen import cli
from datagen.workers.robots import ROBOTS
from tests.linked_environments import install_wheel, link_libraries, own_files, wheel
from tests.sim_extra import needs_sim
from tests.small_runs import CONFIG, OPEN_TOPS, PER_SCENE, make_small_run, submit_arguments
from tests.train.prediction.checkpoints import write_untrained
from tests.train.prediction.seen_scenes import draw_seen, write_frame

pytestmark = pytest.mark.slow

__all__ = ["wheel"]
Command = Sequence[str | Path]
ROBOT = ("--base-height", "0.7", "--reach", "0.9", "--robot-camera-height", "1.2")
MODEL = ("--model-config", "width=16", "--model-config", "embedding=32", "--model-config", "n_points=64")


# Several commands in one process, which imports its libraries once: code and outputs of each.
PROGRAM = """
import contextlib, io, json, sys
from datagen import cli

done = []
for words in json.loads(sys.argv[1]):
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        try:
            code = cli.run(words)
        except SystemExit as end:
            code = end.code
    done.append([code, out.getvalue(), err.getvalue()])
print(json.dumps(done))
"""


@dataclass(frozen=True)
class Done:
    """A command and how it ended."""

    words: list[str]
    code: int
    out: str
    err: str


class Installed:
    """The program of an environment with these extras, in a folder with a user's own modules."""

    def __init__(self, wheel: Path, folder: Path, *extras: str) -> None:
        self.wheel, self.folder, self.bin = wheel, folder, folder / "venv" / "bin"
        link_libraries(install_wheel(wheel, folder / "venv"), *extras)
        (self.bin / "several").write_text(PROGRAM)  # beside `datagen`: in this folder it looks for modules
        own_files(folder)

    def run(self, *commands: Command) -> Iterator[Done]:
        """Do commands in turn: the first by the program itself, as a user does, the rest in one process."""
        first, *rest = ([*map(str, words)] for words in commands)
        program = self._start(self.bin / "datagen", *first)
        yield Done(first, program.returncode, program.stdout, program.stderr)
        python = self._start(self.bin / "python", self.bin / "several", json.dumps(rest))
        assert not (self.folder / "imported").exists(), (self.folder / "imported").read_text()
        assert python.returncode == 0, python.stderr
        yield from (Done(words, *one) for words, one in zip(rest, json.loads(python.stdout), strict=True))

    def _start(self, *command: str | Path) -> subprocess.CompletedProcess[str]:
        environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "RAY_"))}
        return subprocess.run(
            command, cwd=self.folder, capture_output=True, text=True, check=False, timeout=250,
            env=environment | {"OMP_NUM_THREADS": "1"},
        )  # fmt: skip

    def assert_lacks(self, extra: str, done: Done) -> None:
        """The command says that this extra is missing, and how the wheel that is installed brings it."""
        told = f"Install the extra {extra}: pip install '{self.wheel}[{extra}]'"
        assert told in refused_line(done), done


def refused_line(done: Done) -> str:
    """The one line of error of a command that lacks a library; what it began with may stand before it."""
    assert done.code == 2 and done.out == "", done
    *before, line = done.err.splitlines()
    assert line.startswith("error: ") and all(text.startswith("opening ") for text in before), done.err
    return line


def test_the_base_keeps_runs_and_names_what_it_lacks(wheel: Path, copied: Path, tmp_path: Path) -> None:
    base, out = Installed(wheel, tmp_path), tmp_path / "out"
    verbs = ("verify", "audit", "status", "cancel")
    works: list[Command] = [
        ["--help"], ["doctor", "--help"], ["assets", "list"], *([verb, copied] for verb in verbs),
        ["merge", copied, "--out", tmp_path / "merged"],
        ["export", copied, "--to", "webdataset", "--out", tmp_path / "tars"],
    ]  # fmt: skip
    lacks_labels: list[Command] = [
        submit_arguments(out, PER_SCENE),
        ["submit", "sim", "--n", "48", "--out", out],
        ["resume", copied],
        ["show", copied, "--scene", "0", "--out", out],
        ["verify", copied, "--replay", "1"],
    ]
    lacks_train: list[Command] = [
        ["train", "stage1", copied, "--out", out],
        ["evaluate", "model.ckpt", copied],
    ]
    lacks_predict = ["predict", "model.ckpt", "--frame", "frame", *ROBOT]
    lacks_export = ["export", copied, "--to", "parquet", "--out", out]
    done = base.run(*works, ["doctor"], *lacks_labels, *lacks_train, lacks_predict, lacks_export)
    for each in islice(done, len(works)):
        assert each.code == 0, each
    doctor = next(done)
    assert doctor.code == 1 and "Traceback" not in doctor.err
    assert "[labels]" in "".join(doctor.out.split())  # whatever the width of its table
    for each in islice(done, len(lacks_labels)):
        base.assert_lacks("labels", each)
    for each in islice(done, len(lacks_train)):
        base.assert_lacks("train", each)
    base.assert_lacks("predict", next(done))
    base.assert_lacks("export", next(done))
    assert next(done, None) is None and not out.exists()


def test_labels_are_made_and_shown_without_ray_and_torch(wheel: Path, tmp_path: Path) -> None:
    labels, run, other = Installed(wheel, tmp_path, "labels"), tmp_path / "run", tmp_path / "other"
    *made, no_ray, no_cluster, no_sim, no_settler = labels.run(
        submit_arguments(run, PER_SCENE),
        ["show", run, "--scene", "0", "--out", tmp_path / "scene.png"],
        ["verify", run, "--replay", "1"],
        ["relabel", run, "--mu", "0.9", "--out", tmp_path / "relabelled"],
        submit_arguments(other, PER_SCENE, workers=1),
        ["resume", run, "--detach"],
        ["submit", "plan", "--n", "48", "--workers", "0", "--out", other],
        submit_arguments(other, PER_SCENE, config="[settle]\nengine = 'pybullet'\n"),
    )
    for done in made:
        assert done.code == 0, done
    line = refused_line(no_ray)
    assert line.startswith("error: ray: is not installed. Install the extra cluster: ")
    assert "or work in this process: --workers 0" in line
    for extra, done in (("cluster", no_cluster), ("sim", no_sim), ("pybullet", no_settler)):
        labels.assert_lacks(extra, done)
    assert not other.exists()


def test_the_released_model_answers_for_every_registered_robot_without_its_files(
    wheel: Path, tmp_path: Path
) -> None:
    predict, names = Installed(wheel, tmp_path, "predict"), sorted(ROBOTS)
    (tmp_path / "own.toml").write_text('urdf = "own.urdf"\n[arm]\nbase = "base"\ntip = "tool"\n')
    demos = [["predict", "--demo", "--robot", name, "--json"] for name in names]
    page = ["predict", "--demo", "--html", "page.html"]
    *answers, no_sim, no_page = predict.run(*demos, ["predict", "--demo", "--robot", "own.toml"], page)
    for name, done in zip(names, answers, strict=True):
        assert done.code == 0, (name, done.err)
    predict.assert_lacks("page", no_page)
    predict.assert_lacks("sim", no_sim)
    assert no_sim.err.rstrip().endswith("[sim]'")  # no other robot is offered in place of a file


def test_models_train_and_predict_without_simulators(wheel: Path, tmp_path: Path) -> None:
    train = Installed(wheel, tmp_path, "train", "page")
    for split, n in (("train", 48), ("val", PER_SCENE)):
        make_small_run(tmp_path / split, n, "--split", split)
    write_untrained(tmp_path / "model.ckpt", {})
    write_frame(tmp_path / "frame", draw_seen(0))
    given = ["--frame", "frame", *ROBOT, "--out", "heat.png", "--html", "a.html"]
    helped, trained, predicted = train.run(
        ["train", "--help"],
        ["train", "stage1", "train", "--val", "val", "--out", "a.ckpt", "--epochs", "1", *MODEL],
        ["predict", "model.ckpt", *given],
    )
    for done in (helped, trained):
        assert done.code == 0, done
    assert predicted.code in (0, 1), predicted.err  # 1 where a model without training finds no good base
    assert (tmp_path / "heat.png").is_file() and (tmp_path / "a.html").is_file()


@needs_sim
def test_models_are_judged_without_simulators(wheel: Path, tmp_path: Path) -> None:
    train = Installed(wheel, tmp_path, "train")
    (tmp_path / "plan.toml").write_text(CONFIG + OPEN_TOPS + "[arm.grasps]\nper_object = 40\n")
    few = ["--n", "48", "--candidates", "in-range", "--candidates-per-scene", "8", "--workers", "0"]
    made = ["submit", "plan", *few, "--config", str(tmp_path / "plan.toml"), "--out", str(tmp_path / "plans")]
    assert cli.run(made) == 0
    write_untrained(tmp_path / "model.ckpt", {})
    judge = ["evaluate", "model.ckpt", "plans", "--full"]
    judged, no_sim = train.run(judge, [*judge, "--baselines", "reachability"])
    assert judged.code == 0, judged
    assert "[sim]" in "".join(judged.out.split())  # why `reachability` is left out
    train.assert_lacks("sim", no_sim)


@needs_sim
def test_all_extras_label_on_ray_and_show_the_demonstration(wheel: Path, tmp_path: Path) -> None:
    whole, few = Installed(wheel, tmp_path, "all"), ["--n", "48", "--candidates-per-scene", "8"]
    (tmp_path / "plan.toml").write_text(
        CONFIG + OPEN_TOPS + "[arm.grasps]\nper_object = 40\nper_scene = 10\n"
    )
    plan = ["submit", "plan", "--out", "plan", "--candidates", "in-range", "--config", "plan.toml", *few]
    for done in whole.run(plan, ["predict", "--demo"]):
        assert done.code == 0, done
    assert (tmp_path / "demo.png").is_file() and (tmp_path / "demo.html").is_file()

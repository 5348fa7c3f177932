"""The wheel with just those libraries that it asks for: what each extra does, and what is said of others."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from tests.linked_environments import install_wheel, link_libraries, wheel
from tests.small_runs import PER_SCENE, make_small_run, submit_arguments
from tests.train.prediction.checkpoints import write_untrained
from tests.train.prediction.seen_scenes import draw_seen, write_frame

__all__ = ["wheel"]
MODEL = ("--model-config", "width=16", "--model-config", "embedding=32", "--model-config", "n_points=64")


class Installed:
    """The program of an environment with these extras."""

    def __init__(self, wheel: Path, folder: Path, *extras: str) -> None:
        self.wheel, self.folder = wheel, folder
        link_libraries(install_wheel(wheel, folder / "venv"), *extras)

    def run(self, *words: str | Path) -> subprocess.CompletedProcess[str]:
        environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "RAY_"))}
        command = [self.folder / "venv" / "bin" / "datagen", *map(str, words)]
        return subprocess.run(
            command, cwd=self.folder, capture_output=True, text=True, check=False, timeout=250,
            env=environment | {"OMP_NUM_THREADS": "1"},
        )  # fmt: skip

    def succeed(self, *words: str | Path) -> None:
        done = self.run(*words)
        assert done.returncode == 0, done.stderr

    def refused(self, *words: str | Path) -> str:
        """The one line of error of a command that lacks a library; what it began with may stand before it."""
        done = self.run(*words)
        assert done.returncode == 2 and done.stdout == "", done.stdout + done.stderr
        *before, line = done.stderr.splitlines()
        assert line.startswith("error: ") and all(text.startswith("opening ") for text in before), done.stderr
        return line

    def lacks(self, extra: str, *words: str | Path) -> None:
        """A command says that this extra is missing, and how the wheel that is installed brings it."""
        assert f"Install the extra {extra}: pip install '{self.wheel}[{extra}]'" in self.refused(*words)


def test_the_base_keeps_runs_and_names_what_it_lacks(wheel: Path, copied: Path, tmp_path: Path) -> None:
    base = Installed(wheel, tmp_path)
    for words in (["--help"], ["doctor", "--help"], ["assets", "list"]):
        base.succeed(*words)
    for verb in ("verify", "audit", "status", "logs", "seal", "unseal", "repair", "gc", "cancel"):
        base.succeed(verb, copied)
    base.succeed("merge", copied, "--out", tmp_path / "merged")
    doctor = base.run("doctor")
    assert doctor.returncode == 1 and "Traceback" not in doctor.stderr and "[labels]" in doctor.stdout
    out = tmp_path / "out"
    base.lacks("labels", *submit_arguments(out, PER_SCENE))
    base.lacks("labels", "submit", "sim", "--n", "48", "--out", out)
    base.lacks("labels", "resume", copied)
    base.lacks("labels", "show", copied, "--scene", "0", "--out", out)
    base.lacks("labels", "replay", copied, "0")
    base.lacks("labels", "verify", copied, "--deep", "1")
    base.lacks("train", "train", "stage1", copied, "--out", out)
    base.lacks("train", "evaluate", "model.ckpt", copied)
    assert not out.exists()


def test_labels_are_made_and_shown_without_ray_and_torch(wheel: Path, tmp_path: Path) -> None:
    labels, run, other = Installed(wheel, tmp_path, "labels"), tmp_path / "run", tmp_path / "other"
    labels.succeed(*submit_arguments(run, PER_SCENE))
    labels.succeed("show", run, "--scene", "0", "--out", tmp_path / "scene.png")
    labels.succeed("verify", run, "--deep", "1")
    labels.succeed("relabel", run, "--mu", "0.9", "--out", tmp_path / "relabelled")
    line = labels.refused(*submit_arguments(other, PER_SCENE, workers=1))
    assert line.startswith("error: ray: is not installed. Install the extra cluster: ")
    assert "or work in this process: --workers 0" in line
    labels.lacks("cluster", "resume", run, "--detach")
    labels.lacks("sim", "submit", "plan", "--n", "48", "--workers", "0", "--out", other)
    labels.lacks("pybullet", *submit_arguments(other, PER_SCENE, "--settler", "pybullet"))
    labels.lacks("pybullet", *submit_arguments(other, PER_SCENE, "--renderer", "pybullet"))
    assert not other.exists()


def test_models_train_and_predict_without_simulators(wheel: Path, tmp_path: Path) -> None:
    train = Installed(wheel, tmp_path, "train")
    for split in ("train", "val"):
        make_small_run(tmp_path / split, 48, "--split", split)
    train.succeed("train", "stage1", "train", "--val", "val", "--out", "a.ckpt", "--epochs", "1", *MODEL)
    write_untrained(tmp_path / "model.ckpt", {})
    write_frame(tmp_path / "frame", draw_seen(0))
    robot = ("--base-height", "0.7", "--reach", "0.9", "--robot-camera-height", "1.2", "--grid", "5")
    done = train.run(
        "predict", "model.ckpt", "--frame", "frame", *robot, "--out", "heat.png", "--html", "a.html"
    )
    assert done.returncode in (0, 1), done.stderr  # 1 where a model without training finds no good base
    assert (tmp_path / "heat.png").is_file() and (tmp_path / "a.html").is_file()

"""scripts/paper.sh: its commands are commands of ours, in an order in which each finds what it reads."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from datagen.cli import build_app
from datagen.commands.train import model_sizes
from datagen.train.models import build_model
from tests.conftest import REPOSITORY

SCRIPT = Path(__file__).resolve().parent.parent / "scripts" / "paper.sh"

# In place of the program, which would take a quarter of an hour: it notes what it is called with, refuses
# inputs that nobody made, and makes what is asked for, empty.
NOTING = """#!/bin/bash
printf '%q ' "$@" >> "$NOTES"; echo >> "$NOTES"
made=
while [ $# -gt 0 ]; do
    case $1 in
    --out) made=$2; shift ;;
    */runs/*|*.ckpt|*.toml) [ -e "$1" ] || { echo "nobody made $1" >&2; exit 2; } ;;
    esac
    shift
done
[ -n "$made" ] && ! [ -e "$made" ] || exit 0
case $made in */runs/*) mkdir "$made" ;; *) echo made > "$made" ;; esac
"""


def tell(folder: Path, *words: str, **more: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "BIN": str(folder / "bin"), "NOTES": str(folder / "notes"), **more}
    return subprocess.run(
        [SCRIPT, *words], env=environment, cwd=folder, capture_output=True, text=True, check=False
    )


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder with objects of no content and no houses, and with the program that notes its calls."""
    for folder in ("bin", "assets/ycb", "assets/procthor"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "assets/ycb/objects.json").write_text("[]")
    (tmp_path / "bin/datagen").write_text(NOTING)
    (tmp_path / "bin/datagen").chmod(0o755)
    return tmp_path


def notes(place: Path) -> list[list[str]]:
    return [shlex.split(line) for line in (place / "notes").read_text().splitlines()]


@pytest.mark.parametrize("size", ["small", "full"])
def test_its_commands_are_ours_and_the_slow_ones_are_not_repeated(place: Path, size: str) -> None:
    done = tell(place, size, "out", DATAGEN_ASSETS="assets")
    assert done.returncode == 0, done.stderr
    called = notes(place)
    for words in called:
        build_app(words[0]).parse_args(words, exit_on_error=False, print_error=False)
    verbs = [words[0] for words in called]
    assert verbs == ["assets"] + ["submit"] * 7 + ["calibrate", "relabel"] + ["train"] * 8 + ["evaluate"]
    splits = {words[words.index("--out") + 1]: words[words.index("--split") + 1] for words in called[1:8]}
    assert sorted(splits.values()) == ["test"] * 2 + ["train"] * 3 + ["val"] * 2
    trained = {word for words in called if words[0] == "train" for word in words}
    for run, split in splits.items():
        assert (run in trained) == (split != "test" and not run.endswith("heuristic")), run
    assert (place / "out" / "tables.json").is_file()
    # The paper's network in each regime, of a size that the model accepts; ours otherwise.
    of_paper = [words for words in called if "--model" in words]
    assert [(words[1], words[words.index("--model") + 1]) for words in of_paper] == [
        ("stage1", "paper"), ("sim-only", "paper"),
    ]  # fmt: skip
    (sizes,) = {words[words.index("--model-config") + 1] for words in of_paper}
    build_model("paper", model_sizes([sizes]))
    judged = {Path(word).stem for word in called[-1] if word.endswith(".ckpt")}
    assert {"paper-stage1", "paper-sim-only", "paper-stage2", "stage2"} <= judged
    assert any(words[1] == "stage2" and words[-1].endswith("paper-stage1.ckpt") for words in called)

    (place / "notes").unlink()
    assert tell(place, size, "out", DATAGEN_ASSETS="assets").returncode == 0
    again = [words[0] for words in notes(place)]  # those that go on by themselves
    assert again == ["assets"] + ["submit"] * 7 + ["relabel"] + ["train"] * 8


def test_it_stops_where_a_step_fails(place: Path) -> None:
    (place / "bin/datagen").write_text("#!/bin/sh\nexit 130\n")
    assert tell(place, "small", "out", DATAGEN_ASSETS="assets").returncode == 130


@pytest.mark.parametrize(
    ("words", "assets", "told"),
    [(["small"], "nowhere", "DATAGEN_ASSETS"), (["big"], "assets", "small or full")],
)
def test_what_is_missing_is_said_in_one_line(place: Path, words: list[str], assets: str, told: str) -> None:
    done = tell(place, *words, DATAGEN_ASSETS=assets)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1 and told in done.stderr


@pytest.mark.parametrize("script", ["campaign.sh", "paper.sh", "released_model.sh", "bare_root.sh"])
def test_scripts_pass_their_linter(script: str) -> None:
    program = Path(sys.executable).parent / "shellcheck"
    command = [program, "-x", f"scripts/{script}"]  # -x: also what it sources, seen from the checkout
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "")

"""The command line's frame: every kind of error leaves one line and the right exit code."""

from __future__ import annotations

import errno
import importlib
import json as json_format
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

from datagen import __version__, cli
from datagen.console.options import JSON_HELP
from datagen.released import CARD, FOLDER
from datagen.schemas.errors import InputError
from tests.conftest import REPOSITORY
from tests.small_runs import PER_SCENE, arrays_of, submit_arguments


class Box(BaseModel):
    width_m: float
    height_m: float


def refuse_input() -> None:
    raise InputError("run.toml", "scene.n_clutter", "is -1", "Use a number from 0 to 30.")


def interrupt() -> None:
    raise KeyboardInterrupt


def fill_disk() -> None:
    raise OSError(errno.ENOSPC, "No space left on device", "RUN/shards/0.zip")


def deny() -> None:
    raise PermissionError(errno.EACCES, "Permission denied", "RUN")


def break_model() -> None:
    Box.model_validate({"width_m": "wide\nand\nwider" * 20, "height_m": None})


def break_program() -> None:
    raise ZeroDivisionError("a defect")


def answer(*, n: int = 0) -> int:
    return n


@pytest.fixture
def with_verbs(monkeypatch: pytest.MonkeyPatch) -> None:
    """The real program with further verbs that end in each of the ways a verb can end."""
    own = (refuse_input, interrupt, fill_disk, deny, break_model, break_program, answer)
    table = {f.__name__.replace("_", "-"): (f"{__name__}:{f.__name__}", f.__name__) for f in own}
    monkeypatch.setattr(cli, "VERBS", {**cli.VERBS, **table})


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["refuse-input"], 2, ["run.toml", "scene.n_clutter", "is -1", "0 to 30"]),
        (["interrupt"], 130, ["interrupted"]),
        (["fill-disk"], 2, ["RUN/shards/0.zip", "No space left on device. Free disk space"]),
        (["deny"], 2, ["RUN", "Permission denied", "permission"]),
        (["answer", "--n", "many"], 2, ["--n", "many", "int"]),
        (["answer", "--m", "1"], 2, ["--m", "--help"]),
        (["answer", "--n"], 2, ["datagen answer: --n has no value"]),
        (["answer", "surplus", "tokens"], 2, ['unexpected argument "surplus tokens"']),
        (["statsu"], 2, ['unknown command "statsu". Did you mean status?']),
        (["xyz"], 2, ['unknown command "xyz". See: datagen --help']),
        (["--bogus"], 2, ['unknown option "--bogus"']),
        (["submit", "heuristic"], 2, ["--n is missing: Labels wanted", "For example: datagen submit"]),
        (["submit", "heuristic", "--m", "5"], 2, ["Did you mean --n instead of --m?"]),
        (["audit"], 2, ["datagen audit: RUN... is missing: Runs of"]),
        (["relabel", "r", "--out", "o", "--mu", "far"], 2, ['--mu: "far" is not a number']),
    ],
)
@pytest.mark.usefixtures("with_verbs")
def test_an_error_is_one_line(
    arguments: list[str], code: int, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(arguments) == code
    told = capsys.readouterr()
    assert told.out == ""
    assert len(told.err.splitlines()) == 1
    assert "Traceback" not in told.err
    for word in words:
        assert word in told.err


@pytest.mark.usefixtures("with_verbs")
def test_a_refused_model_is_one_line_a_field(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["break-model"]) == 2
    lines = capsys.readouterr().err.splitlines()
    fields = [["error", "Box", name] for name in ("width_m", "height_m")]
    assert [line.split(": ")[:3] for line in lines] == fields
    assert all(len(line) < 250 for line in lines)


@pytest.mark.usefixtures("with_verbs")
def test_a_defect_keeps_its_traceback_and_a_verb_decides_the_exit_code() -> None:
    with pytest.raises(ZeroDivisionError):
        cli.run(["break-program"])
    assert [cli.run(["answer", "--n", str(code)]) for code in (0, 1, 2)] == [0, 1, 2]


@given(st.text(alphabet=st.characters(exclude_characters="\0"), max_size=30))
def test_no_first_word_gives_a_traceback(word: str) -> None:
    if word.strip() in cli.VERBS:
        return
    assert cli.run([word]) in (0, 2)


@given(st.text())
def test_one_line_holds_no_breaks(text: str) -> None:
    assert len(cli.one_line(text).splitlines()) <= 1


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["--version"]) == 0
    assert capsys.readouterr().out.strip() == f"datagen {__version__}"


def test_help_imports_no_engine() -> None:
    code = (
        "import sys; from datagen import cli; cli.run(['--help']); "
        "heavy = {'numpy', 'ray', 'sapien', 'pybullet', 'zarr', 'matplotlib', 'trimesh', 'pydantic'}; "
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    for verb in cli.VERBS:
        assert verb in done.stdout


@pytest.mark.parametrize("verb", sorted(cli.VERBS))
def test_every_verb_exists(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    module, _, attribute = cli.VERBS[verb][0].partition(":")
    assert hasattr(importlib.import_module(module), attribute)
    assert cli.run([verb, "--help"]) == 0
    assert "datagen " + verb in capsys.readouterr().out


@pytest.mark.parametrize("words", ["--help", "assets list", "assets list --json"])
def test_a_closed_pipe_is_quiet(words: str, tmp_path: Path) -> None:
    errors = tmp_path / "stderr"
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "wb") as out, errors.open("wb") as err:
        command = [sys.executable, "-m", "datagen.cli", *words.split()]
        done = subprocess.run(command, check=False, stdout=out, stderr=err)
    assert errors.read_text() == "" and done.returncode == cli.EXIT_CLOSED_PIPE


@pytest.mark.parametrize("words", ["--help", "--version", "assets list", "assets list --json"])
@pytest.mark.parametrize("closed", ["<&-", ">&-", ">&- <&-", ">&- 2>&- <&-"])
def test_closed_streams_are_quiet(words: str, closed: str, tmp_path: Path) -> None:
    errors = "" if "2>" in closed else f"2>'{tmp_path / 'stderr'}'"
    (tmp_path / "stderr").touch()
    command = f"'{sys.executable}' -m datagen.cli {words} {errors} {closed}"
    done = subprocess.run(["bash", "-c", command], check=False, capture_output=True)
    assert (done.returncode, (tmp_path / "stderr").read_text()) == (0, "")


HELPS = [
    *([verb] for verb in sorted(cli.VERBS)), ["assets", "fetch"], ["assets", "list"], ["assets", "split"],
    ["benchmark", "make"], ["benchmark", "score"],
]  # fmt: skip


@pytest.mark.parametrize("words", HELPS, ids=" ".join)
def test_defaults_and_json_have_one_form_in_every_help(
    words: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "400")
    assert cli.run([*words, "--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for line in lines:
        for shown in re.findall(r"\[([^\]]+)\]", line.partition("Usage:")[0]):
            assert re.match(r"default: |required$|choices: |,YAW$|heuristic$|OPTIONS$|ARGS$", shown), line
    (json,) = [line for line in lines if re.search(r"--json\b", line)] or [JSON_HELP]
    assert JSON_HELP in json


def test_documents_have_that_form_of_defaults() -> None:
    for page in sorted((REPOSITORY / "docs").rglob("*.md")):
        for row in page.read_text().splitlines():
            if row.startswith("|"):
                assert not re.search(r" \[\w+\](?!\()", row), f"{page}: {row}"


def test_the_example_of_predict_is_within_the_range_of_the_model(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["predict", "--help"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    robots = json_format.loads((FOLDER / CARD).read_text())["data"][0]["robots"]  # of the scaled Panda
    for option, field in (("--base-height", "base_height_m"), ("--reach", "arm_reach_m")):
        value = re.search(rf"For example: datagen predict .*?{option} ([0-9.]+)", shown)
        assert value is not None and robots[field][0] <= float(value[1]) <= robots[field][1], option


def test_a_machine_without_loopback_is_refused_at_once(tmp_path: Path) -> None:
    """Ray would wait for its own processes for ever."""
    bare = ["unshare", "--user", "--map-root-user", "--net"]
    if subprocess.run([*bare, "true"], check=False, capture_output=True).returncode:
        pytest.skip("no namespaces here")
    command = [*bare, sys.executable, "-m", "datagen.cli", *submit_arguments(tmp_path / "run", 8, workers=1)]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "loopback" in done.stderr and "ip link set lo up" in done.stderr and "--workers 0" in done.stderr


@pytest.mark.parametrize("extra", [0, 4])
def test_a_job_says_how_many_labels_it_made_and_how_many_count(
    extra: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    n = 2 * PER_SCENE - extra
    assert cli.run([*submit_arguments(tmp_path / "run", n), "--json"]) == 0
    result = json_format.loads(capsys.readouterr().out)
    assert (result["end"], result["labels"], result["n"]) == ("complete", 2 * PER_SCENE, n)
    assert result["run"] == str(tmp_path / "run") and result["store"].endswith("data.zarr")
    assert cli.run(submit_arguments(tmp_path / "other", n)) == 0
    shown = capsys.readouterr().out
    stored = arrays_of(tmp_path / "other")["label"].shape[0]
    assert stored == n
    wanted = "16 new in whole shards; readers get the 12 wanted" if extra else "16 new of 16 wanted"
    assert wanted in shown
    assert cli.run(["status", str(tmp_path / "run")]) == 0
    assert "run run" not in capsys.readouterr().out.replace(str(tmp_path) + "/", "")


def test_the_home_folder_is_found_where_a_shell_leaves_its_sign(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    home, work = tmp_path / "home", tmp_path / "work"
    for folder in (home, work):
        folder.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.chdir(work)
    words = ["predict", "--demo", "--export=~/frame", "--out=~/answer.png", "--html", "~/answer.html"]
    assert cli.run(words) == 0
    assert f"{home}/frame" in capsys.readouterr().out
    assert {each.name for each in home.iterdir()} >= {"frame", "answer.png", "answer.html"}
    assert not list(work.iterdir())  # no folder named ~

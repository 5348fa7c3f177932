"""`datagen merge` as a user meets it: real small runs, and every other verb on what comes out."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from datagen import cli
from datagen.schemas.run import Run, open_runs
from tests.made_runs import make_run
from tests.refusals import refused
from tests.small_runs import arrays_of, assert_equal_runs, files_of, json_of, make_small_run

N = 48  # 6 scenes


@pytest.fixture(scope="module")
def apart(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a whole run, two parts of it made apart, and one of another seed."""
    folder = tmp_path_factory.mktemp("apart")
    make_small_run(folder / "whole", N)
    make_small_run(folder / "first", N // 2)
    make_small_run(folder / "other", N // 2, "--seed", "7")
    return folder


@pytest.fixture(scope="module")
def merged(apart: Path) -> Path:
    """The run and that of another seed in one place."""
    assert cli.run(["merge", str(apart / "whole"), str(apart / "other"), "--out", str(apart / "merged")]) == 0
    return apart / "merged"


def test_runs_of_one_specification_give_the_store_of_one_run(
    apart: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    before = files_of(apart / "first")
    out = tmp_path / "out"
    arguments = ["merge", str(apart / "first"), str(apart / "whole"), "--out", str(out)]
    report = json_of(capsys, arguments)
    assert (report["labels"], report["n"]) == (N, N)
    (part,) = report["runs"]
    assert part["missing_shards"] == 0
    assert_equal_runs(arrays_of(out), arrays_of(apart / "whole"))
    assert files_of(apart / "first") == before
    spending = [json_of(capsys, ["audit", str(apart / name)])["sources"][0] for name in ("first", "whole")]
    (united,) = json_of(capsys, ["audit", str(out)])["sources"]
    assert united["wall_s"] == pytest.approx(sum(source["wall_s"] for source in spending), abs=1e-6)
    files = files_of(out)
    assert json_of(capsys, arguments)["runs"][0]["shards"]["copied"] == 0
    assert files_of(out) == files


def test_every_reading_verb_takes_it(merged: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    status = json_of(capsys, ["status", str(merged)])
    assert (status["labels"], status["n"], status["complete"]) == (N + N // 2, N + N // 2, True)
    audit = json_of(capsys, ["audit", str(merged)])
    assert audit["sources"][0]["counts"]["label"] == N + N // 2
    verified = json_of(capsys, ["verify", str(merged)])
    assert verified["findings"] == []
    second = -(-open_runs(merged)[0].n // 8)  # the first scene of the second part
    picture = tmp_path / "scene.png"
    assert cli.run(["show", str(merged), "--scene", str(second), "--out", str(picture)]) == 0
    assert picture.stat().st_size > 10_000
    refused(["show", str(merged), "--scene", "9", "--out", str(picture)], capsys, "Give one from 0 to 8")


def test_refusals_are_one_line(apart: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = str(tmp_path / "out")
    make_run(tmp_path / "foreign", 10, shards=[0])
    refused(["merge", "--out", out], capsys, "RUN... is missing")
    refused(["merge", str(tmp_path / "nowhere"), "--out", out], capsys, "no such folder")
    refused(["merge", str(tmp_path), "--out", out], capsys, "not a run")
    kinds = ["merge", str(apart / "whole"), str(tmp_path / "foreign"), "--out", out]
    refused(kinds, capsys, "differs in kind", "engines", str(apart / "whole"), str(tmp_path / "foreign"))
    joins = ["merge", str(apart / "other"), "--out", str(apart / "whole")]
    refused(joins, capsys, "another specification", "Choose a new --out")
    assert not Path(out).exists()


def test_it_says_what_came_from_where_and_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    make_run(tmp_path / "a", 40, shards=[0, 1])
    make_run(tmp_path / "b", 40, shards=[1, 2])
    out = tmp_path / "out"
    command = ["merge", str(tmp_path / "a"), str(tmp_path / "b"), "--out", str(out)]
    assert cli.run(command) == 0
    told = " ".join(capsys.readouterr().out.split())
    words = (f"merged: {out}", "labels 30 of 40; missing shards: 1", f"datagen resume {out}", "3 copied")
    for word in (*words, "1 duplicates"):
        assert word in told, (word, told)
    make_run(tmp_path / "b", 40)
    assert cli.run(command) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "labels 40 of 40 store" in told, told
    assert "3 merged before, 1 copied" in told
    assert "datagen resume" not in told


def test_an_interrupted_merge_says_how_to_go_on(apart: Path, tmp_path: Path):
    """A real Ctrl-C at the first shard that is written."""
    program = (
        "import os, signal, sys\n"
        "from datagen import cli\n"
        "from datagen.schemas.run import Run\n"
        # What a shell starts in the background ignores it.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "commit = Run.commit\n"
        "Run.commit = lambda *given: (commit(*given), os.kill(os.getpid(), signal.SIGINT))[0]\n"
        "sys.exit(cli.run(sys.argv[1:]))"
    )
    out = tmp_path / "out"
    command = ["merge", str(apart / "first"), str(apart / "whole"), "--out", str(out)]
    run = subprocess.run(
        [sys.executable, "-c", program, *command], capture_output=True, text=True, check=False
    )
    assert run.returncode == 130, run.stderr
    said = "interrupted; committed shards are kept. Resume with:"
    assert run.stderr == f"{said}\n  datagen {' '.join(command)}\ninterrupted\n"
    assert len(Run.open(out).committed()) == 1
    assert cli.run(command) == 0
    assert_equal_runs(arrays_of(out), arrays_of(apart / "whole"))

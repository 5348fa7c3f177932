"""`datagen benchmark make`: the same runs again, and the definition that the package ships."""

from __future__ import annotations

import json
import runpy
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest

from datagen import cli
from datagen.cli import build_app
from datagen.console.command_lines import Interrupted
from datagen.evaluation.benchmark import read_benchmark
from datagen.jobs.job import Job
from datagen.jobs.job_report import JobResult
from tests.conftest import REPOSITORY
from tests.sim_extra import needs_sim
from tests.small_runs import arrays_of, assert_equal_runs


def made(out: Path, definition: dict[str, Any] | str, *more: str) -> int:
    """Make the runs of a definition in `out`."""
    out.mkdir(exist_ok=True)
    text = definition if isinstance(definition, str) else json.dumps(definition)
    (out / "benchmark.json").write_text(text)
    sources = ["--houses", "builtin", "--objects", "builtin", "--workers", "0"]
    return cli.run(["benchmark", "make", *sources, "--out", str(out), *more])


@pytest.fixture
def definition(small_benchmark: Path) -> dict[str, Any]:
    return json.loads((small_benchmark / "benchmark.json").read_text())


@pytest.mark.slow
@needs_sim
def test_the_runs_are_made_again_bit_for_bit(
    small_benchmark: Path, definition: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert made(tmp_path, definition, "--run", "test") == 0
    assert "candidates and labels as frozen" in capsys.readouterr().out
    assert_equal_runs(arrays_of(tmp_path / "test"), arrays_of(small_benchmark / "test"))
    assert not (tmp_path / "grids").exists()
    assert made(tmp_path, definition, "--run", "test") == 0
    assert "nothing to do" in capsys.readouterr().out


@needs_sim
def test_an_interrupted_command_says_how_to_resume_itself(
    definition: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def stopped(job: Job) -> JobResult:
        resume = tuple(job.resume)
        raise Interrupted("1 shard left", JobResult("x", "interrupted", remaining=1, resume=resume))

    monkeypatch.setattr(Job, "run", stopped)
    assert made(tmp_path, definition, "--run", "test") == 130
    told = capsys.readouterr().err
    assert "interrupted; 1 shard left. Resume with:\n  datagen benchmark make --houses builtin" in told
    (line,) = [each for each in told.splitlines() if each.startswith("  datagen ")]
    build_app("benchmark").parse_args(shlex.split(line)[1:], exit_on_error=False, print_error=False)
    assert f"--out {tmp_path} --run test" in line


@needs_sim
def test_other_engines_or_sources_are_refused_before_anything_is_written(
    definition: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path, told in (
        (("engines", "numpy"), "engines: numpy: the run has"),
        (("houses", "digest"), "--houses: builtin: holds builtin"),
    ):
        changed = json.loads(json.dumps(definition))
        changed["runs"]["test"]["spec"][path[0]][path[1]] = "0" * 64
        assert made(tmp_path / path[0], changed) == 2
        assert told in capsys.readouterr().err
        assert not (tmp_path / path[0] / "test").exists()


@needs_sim
def test_labels_that_differ_are_not_the_benchmark(
    definition: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    definition["runs"]["test"]["digests"]["labels"] = "0" * 64
    assert made(tmp_path, definition, "--run", "test") == 2
    assert "labels: have the digest" in capsys.readouterr().err


@needs_sim
def test_freezing_writes_the_digests_of_the_runs(
    small_benchmark: Path, definition: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = read_benchmark(small_benchmark)
    for run in definition["runs"].values():
        run["digests"] = None
    definition["runs"]["later"] = definition["runs"]["test"] | {"about": "not made"}
    for name in known.runs:
        (tmp_path / name).symlink_to(small_benchmark / name)
    (tmp_path / "benchmark.json").write_text(json.dumps(definition))
    monkeypatch.setattr(sys, "argv", ["freeze", str(tmp_path), "--version", "2"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(REPOSITORY / "scripts" / "freeze_benchmark.py"), run_name="__main__")
    assert ended.value.code == 1
    frozen = read_benchmark(tmp_path)
    assert frozen.version == "2" and frozen.runs["later"].digests is None
    assert {n: frozen.runs[n] for n in known.runs} == known.runs


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "Invalid JSON"),
        ("{}", "version: Field required"),
        ('{"version": "1", "runs": {"../x": {}}}', "runs"),
    ],
)
def test_a_broken_definition_is_one_line(
    text: str, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert made(tmp_path, text) == 2
    error = capsys.readouterr().err
    assert told in error and error.count("\n") == 1


def test_the_shipped_definition_holds_out_houses_and_objects() -> None:
    shipped = read_benchmark()
    grids = ["grids", "grids-ur5", "grids-stretch3", "grids-tiago-pro", "grids-pr2"]
    assert list(shipped.runs) == [*grids, "test", "trials", "tops"]
    assert {run.spec.split for run in shipped.runs.values()} == {"test"}
    assert {run.objects for run in shipped.runs.values()} == {"test"}
    assert [name for name, run in shipped.runs.items() if run.is_of_grids] == grids
    assert [name for name, run in shipped.runs.items() if run.spec.scene.places is None] == ["tops"]
    assert all(run.digests is not None for run in shipped.runs.values())
    assert [name for name, run in shipped.runs.items() if run.spec.label_source == "sim"] == ["trials"]


def test_its_objects_are_the_division_of_the_real_ones(assets: Path, tmp_path: Path) -> None:
    from datagen.assets.object_split import split_objects
    from datagen.workers.objects import open_objects

    split_objects(assets / "ycb", tmp_path)
    shipped = read_benchmark()
    for run in shipped.runs.values():
        assert open_objects(f"ycb:{tmp_path / run.objects}").digest == run.spec.objects.digest

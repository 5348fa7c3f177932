"""Whole runs through the command line: made, resumed, killed, interrupted, read."""

from __future__ import annotations

import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from datagen import cli
from datagen.schemas.run import Run
from datagen.schemas.run_records import AttemptStart
from tests.conftest import REPOSITORY
from tests.made_runs import give_up
from tests.refusals import refused
from tests.small_runs import (
    PER_SCENE,
    arrays_of,
    assert_equal_runs,
    files_of,
    json_of,
    make_small_run,
    submit_arguments,
)
from tests.workers.objects.toy_set import write_bundle

N, LONG_N = 8 * PER_SCENE, 16 * PER_SCENE


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight scenes, one a shard. Tests only read it."""
    return make_small_run(tmp_path_factory.mktemp("finished") / "run", N)


@pytest.fixture(scope="module")
def finished_long(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixteen scenes of the same specification, two a shard, made without interruption."""
    return make_small_run(tmp_path_factory.mktemp("long") / "run", LONG_N)


def test_the_same_command_again_does_nothing_and_says_so(
    copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = ("plans", "shards", "commits", "ledger")
    before, arrays = files_of(copied, *folders), arrays_of(copied)
    capsys.readouterr()
    assert cli.run(submit_arguments(copied, N)) == 0
    told = capsys.readouterr()
    assert "nothing to do" in told.out and f"{N} labels" in told.out
    assert files_of(copied, *folders) == before
    assert_equal_runs(arrays_of(copied), arrays)
    assert cli.run(submit_arguments(copied, N - PER_SCENE)) == 0  # a run never shrinks
    assert_equal_runs(arrays_of(copied), arrays)


def test_a_run_with_shards_given_up_says_so_again(copied: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, arrays = Run.open(copied), arrays_of(copied)
    for shard in (2, 5):
        (copied / f"commits/{shard:06d}.json").unlink()
        give_up(run, shard, "failed: no luck")
    capsys.readouterr()
    assert cli.run(submit_arguments(copied, N)) == 1
    told = capsys.readouterr()
    assert "committed or quarantined" in told.out and "2 shards (2, 5)" in told.out and "no luck" in told.err
    assert arrays_of(copied)["label"].shape == (N - 2 * PER_SCENE,)
    shutil.rmtree(copied / "quarantine")  # as the message says
    assert cli.run(submit_arguments(copied, N)) == 0
    assert_equal_runs(arrays_of(copied), arrays)


@pytest.mark.parametrize(
    ("more", "fields"),
    [
        (["--seed", "5"], ["seed: 0, but 5 was given"]),
        (["--split", "val", "--candidates", "clear"], ["split", "'all'", "'val'", "candidates.within"]),
        (["--candidates-per-scene", "9"], ["candidates_per_scene", "8", "9"]),
    ],
)
def test_another_specification_is_refused_and_changes_nothing(
    finished: Path, more: list[str], fields: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = submit_arguments(finished, N)
    if more[0] in arguments:
        at = arguments.index(more[0])
        del arguments[at : at + 2]
    before = files_of(finished)
    refused([*arguments, *more], capsys, str(finished), *fields)
    assert files_of(finished) == before


def test_status_tells_an_older_seal(copied: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Run.open(copied).grow(2 * N)
    report = json_of(capsys, ["status", str(copied)])
    assert not report["sealed"] and report["sealed_labels"] == N
    assert cli.run(["status", str(copied)]) == 0
    assert "data.zarr is out of date" in capsys.readouterr().out
    # Sealed unfinished, it holds no more labels than before.
    assert cli.run(["verify", str(copied), "--repair"]) == 0
    Run.open(copied).grow(3 * N)
    capsys.readouterr()
    assert json_of(capsys, ["status", str(copied)])["sealed_labels"] == N


def test_two_ray_workers_make_the_same_arrays(finished_long: Path, tmp_path: Path) -> None:
    # In a process of its own: Ray keeps threads and handlers in the process that started it.
    run = tmp_path / "run"
    done = subprocess.run(
        [sys.executable, "-m", "datagen.cli", *submit_arguments(run, LONG_N, workers=2)],
        cwd=REPOSITORY, capture_output=True, text=True, timeout=900, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert_equal_runs(arrays_of(run), arrays_of(finished_long))
    assert len({commit.host.pid for commit in Run.open(run).commits()}) == 2


class Job:
    """`datagen submit` in a process of its own, to be stopped from outside."""

    def __init__(self, run: Path) -> None:
        self.run = run
        arguments = [sys.executable, "-m", "datagen.cli", *submit_arguments(run, LONG_N)]
        self.process = subprocess.Popen(
            arguments, cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def wait_until_committed(self, shards: int) -> None:
        while len(list(self.run.glob("commits/*.json"))) < shards:
            assert self.process.poll() is None, self.process.communicate()
            time.sleep(0.02)


def unfinished(path: Path) -> list[AttemptStart]:
    run = Run.open(path)
    return run.ledger.unfinished({commit.attempt for commit in run.commits()})


def test_a_killed_driver_resumes_to_the_same_arrays(finished_long: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    job = Job(run)
    job.wait_until_committed(2)
    while True:  # look at it while it stands still, and kill it in the middle of an attempt
        job.process.send_signal(signal.SIGSTOP)
        lost = unfinished(run)
        if lost and lost[0].shard not in Run.open(run).committed():
            break
        job.process.send_signal(signal.SIGCONT)
        time.sleep(0.05)
        assert job.process.poll() is None, job.process.communicate()
    job.process.kill()
    assert job.process.wait(600) == -signal.SIGKILL
    kept = files_of(run, "commits", "shards")
    assert not (run / "data.zarr").exists() and Run.open(run).missing()

    assert cli.run(submit_arguments(run, LONG_N)) == 0
    assert kept.items() <= files_of(run, "commits", "shards").items()
    assert_equal_runs(arrays_of(run), arrays_of(finished_long))
    ends = {entry.attempt: entry for entry in Run.open(run).ledger.ends()}
    assert Counter(entry.outcome for entry in ends.values()) == {"lost": 1}
    assert ends[lost[0].attempt].outcome == "lost" and ends[lost[0].attempt].cost is None
    assert unfinished(run) == []


def test_ctrl_c_says_how_to_resume_and_that_command_completes(finished_long: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    job = Job(run)
    job.wait_until_committed(2)
    job.process.send_signal(signal.SIGINT)
    _, told = job.process.communicate(timeout=600)
    assert job.process.returncode == 130
    assert "Traceback" not in told and "interrupted" in told
    assert 2 <= len(Run.open(run).committed()) < 8 and unfinished(run) == []
    (line,) = [line for line in told.splitlines() if line.strip().startswith("datagen ")]
    assert cli.run(shlex.split(line)[1:]) == 0
    assert_equal_runs(arrays_of(run), arrays_of(finished_long))


def test_a_count_of_built_in_houses_and_a_relative_folder_reach_the_workers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_small_run(tmp_path / "run", PER_SCENE, "--houses", "builtin:30")
    sources = Run.open(run).manifest.sources
    assert sources == {"houses": "builtin:30", "objects": "builtin", "n_houses": "30", "n_objects": "58"}
    folder = tmp_path / "objects"
    folder.mkdir()
    monkeypatch.chdir(tmp_path)
    arguments = submit_arguments(tmp_path / "other", PER_SCENE, "--objects", "ycb:objects")
    assert cli.run(arguments) == 2  # an empty folder, found from here
    write_bundle(folder, *(f"{k:03d}_cube" for k in range(8)))
    assert cli.run(arguments) == 0
    monkeypatch.chdir("/")
    assert cli.run(["show", str(tmp_path / "other"), "--out", str(tmp_path / "a.png")]) == 0

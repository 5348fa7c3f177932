"""A job outlives its readers: progress and a last summary that cannot be written are dropped."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import threading
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import pytest

from datagen.display.progress import Progress
from datagen.schemas.jobs import Jobs
from datagen.schemas.run import Run
from tests.conftest import REPOSITORY
from tests.small_runs import PER_SCENE, make_small_run, submit_arguments

N = 2 * PER_SCENE


@contextmanager
def closed_pipe() -> Generator[int]:
    """A pipe whose reader has ended."""
    reading, writing = os.pipe()
    os.close(reading)
    yield writing
    os.close(writing)


@contextmanager
def full_disk() -> Generator[int]:
    with open("/dev/full", "wb", buffering=0) as file:
        yield file.fileno()


UNWRITABLE = {"closed pipe": closed_pipe, "full disk": full_disk}


def assert_complete(run: Path) -> None:
    assert len(Run.open(run).committed()) == 2 and (run / "data.zarr").is_dir()
    (job,) = Jobs(Run.open(run).storage).all()
    assert job.state is not None and (job.state.end, job.state.exit_code) == ("complete", 0)


@pytest.mark.parametrize(
    ("observer", "streams", "workers", "more"),
    [
        ("closed pipe", "progress", 0, []),
        ("closed pipe", "summary", 0, []),
        ("closed pipe", "both", 0, ["--json"]),
        ("closed pipe", "both", 1, []),
        ("full disk", "progress", 1, []),
        ("full disk", "summary", 0, ["--json"]),
        ("full disk", "both", 0, []),
    ],
)
def test_a_job_whose_output_nobody_reads_makes_all_labels(
    observer: str, streams: str, workers: int, more: list[str], tmp_path: Path
) -> None:
    command = [sys.executable, "-m", "datagen.cli"]
    command += submit_arguments(tmp_path / "run", N, *more, workers=workers)
    with UNWRITABLE[observer]() as unwritable, (tmp_path / "read").open("wb") as read:
        out = read.fileno() if streams == "progress" else unwritable
        err = read.fileno() if streams == "summary" else unwritable
        done = subprocess.run(command, stdout=out, stderr=err, cwd=REPOSITORY, check=False)
    assert done.returncode == 0, (tmp_path / "read").read_text()
    assert "Traceback" not in (tmp_path / "read").read_text()
    assert_complete(tmp_path / "run")


@pytest.mark.parametrize(("verb", "observer"), [("merge", "closed pipe"), ("relabel", "full disk")])
def test_so_do_merges_and_relabelled_runs(verb: str, observer: str, tmp_path: Path) -> None:
    run = make_small_run(tmp_path / "run", N)
    command = [sys.executable, "-m", "datagen.cli", verb, str(run), "--out", str(tmp_path / "new")]
    command += ["--tau", "0.2"] if verb == "relabel" else []
    with UNWRITABLE[observer]() as unwritable:
        done = subprocess.run(command, stdout=unwritable, stderr=unwritable, cwd=REPOSITORY, check=False)
    assert done.returncode == 0 and (tmp_path / "new" / "data.zarr").exists()


def test_a_python_program_makes_its_labels_as_well(tmp_path: Path) -> None:
    program = (
        f"import datagen; r = datagen.submit('heuristic', n={N}, out={str(tmp_path / 'run')!r}, "
        f"candidates_per_scene={PER_SCENE}, workers=0); assert r.complete"
    )
    with closed_pipe() as unwritable:
        command = [sys.executable, "-c", program]
        subprocess.run(command, stdout=unwritable, stderr=unwritable, cwd=REPOSITORY, check=False)
    assert_complete(tmp_path / "run")


@pytest.mark.parametrize("observer", sorted(UNWRITABLE))
def test_an_error_that_cannot_be_printed_keeps_its_exit_code(observer: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "datagen.cli", "status", str(tmp_path / "missing")]
    with UNWRITABLE[observer]() as unwritable:
        done = subprocess.run(command, stderr=unwritable, cwd=REPOSITORY, check=False)
    assert done.returncode == 2


def test_output_that_is_the_result_is_not_dropped(tmp_path: Path) -> None:
    run = make_small_run(tmp_path / "run", PER_SCENE)
    command = [sys.executable, "-m", "datagen.cli", "status", str(run)]
    with full_disk() as unwritable:
        done = subprocess.run(command, stdout=unwritable, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 2 and done.stderr.startswith("error: ") and done.stderr.count("\n") == 1


class LostTerminal(io.StringIO):
    def isatty(self) -> bool:
        return True

    def write(self, s: str) -> int:
        raise OSError(5, "Input/output error")


@pytest.mark.parametrize("as_json", [False, True])
def test_a_bar_on_a_terminal_that_is_gone_is_dropped(as_json: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stderr", LostTerminal())
    failed: list[object] = []
    monkeypatch.setattr(threading, "excepthook", failed.append)  # the bar is drawn by a thread
    with Progress(as_json) as progress:
        progress.phase("opening runs")
        progress.update("shards", 1, 2, lambda: ("1/s", {}))
        progress.say("note", {}, "a note")
    assert not failed


def test_a_reader_that_does_not_read_does_not_stop_the_job(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    with os.fdopen(writing, "w") as stream, os.fdopen(reading, "rb"):
        monkeypatch.setattr(sys, "stderr", stream)

        def report() -> None:
            with Progress() as progress:
                for k in range(2000):
                    progress.say("note", {}, f"{k:100d}")

        job = threading.Thread(target=report, daemon=True)
        job.start()
        job.join(60)
        assert not job.is_alive()

"""A job handed over to a real Ray head: it goes on when its shell is killed, and answers other shells."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from datagen import cli
from datagen.cluster.ray_head import running_head, state_folder, stop_head
from datagen.schemas.jobs import Jobs
from datagen.schemas.run import Run
from datagen.schemas.storage import open_storage
from tests.refusals import refused
from tests.small_runs import (
    PER_SCENE,
    arrays_of,
    assert_equal_runs,
    json_of,
    make_small_run,
    submit_arguments,
)

REPOSITORY = Path(__file__).resolve().parents[3]
N = 8 * PER_SCENE


@pytest.fixture(scope="module")
def state(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A state folder of our own, and no head when the tests are done."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DATAGEN_STATE", str(tmp_path_factory.mktemp("state") / "here"))
        yield state_folder()
        stop_head()


def test_a_detached_job_outlives_its_shell_and_is_followed_from_another(
    state: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    for _ in range(2):  # a head that does not start in time is refused, and a busy machine may need longer
        # A shell in a session of its own, which dies with all that it started.
        shell = subprocess.Popen(
            [sys.executable, "-m", "datagen.cli", *submit_arguments(run, N, workers=1), "--detach"],
            cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        )  # fmt: skip
        out, err = shell.communicate(timeout=600)
        if shell.returncode != 2 or "does not start" not in err:
            break
    assert shell.returncode == 0, err
    told = "".join(out.split())  # a long path is broken into lines
    assert f"datagenlogs{run}--follow" in told and "datagencancel" in told
    try:
        os.killpg(shell.pid, signal.SIGKILL)
    except ProcessLookupError:
        pass  # nothing of it is left, which is as good

    # What stays listens on loopback, wants a token, and its file is the user's alone.
    head = running_head()
    assert head is not None and (state / "head.json").stat().st_mode & 0o777 == 0o600
    assert Path(head.folder).stat().st_mode & 0o777 == 0o700
    listening = {
        connection.laddr.ip
        for process in psutil.process_iter()
        if _group_of(process) == head.group
        for connection in process.net_connections("inet")
        if connection.status == psutil.CONN_LISTEN
    }
    assert listening and listening <= {"127.0.0.1", "::ffff:127.0.0.1", "::1"}
    refused(["submit", "heuristic", "--n", "8", "--out", str(tmp_path / "no"), "--detach", "--address",
             head.jobs_api], capsys, head.jobs_api)  # fmt: skip

    jobs = Jobs(open_storage(run))
    while not (found := jobs.all()) or found[0].health() != "ended":
        time.sleep(0.2)
        assert running_head() == head
    record = found[0].record
    assert record.submission in out and record.jobs_api == head.jobs_api and record.pid != shell.pid
    report = json_of(capsys, ["status", str(run)])
    assert report["complete"] and report["sealed"] and report["jobs"][0]["state"]["exit_code"] == 0
    assert cli.run(["logs", str(run), "--driver"]) == 0
    assert f"complete: {run}" in capsys.readouterr().out.replace("\n", "")
    assert_equal_runs(arrays_of(run), arrays_of(make_small_run(tmp_path / "here", N)))

    # The same head takes the next one, which another shell stops.
    assert cli.run(["extend", str(run), "--n", str(40 * N), "--workers", "1", "--detach"]) == 0
    capsys.readouterr()
    assert running_head() == head
    while len(jobs.all()) < 2:
        time.sleep(0.1)
    refused(["cancel", "--head"], capsys, "at work: 1 job", "extend")
    assert cli.run(["cancel", str(run), "--now"]) == 0
    told = capsys.readouterr().out
    assert "ended interrupted" in told
    resume = next(r for r in _driver_lines(run, capsys) if r.strip().startswith("datagen resume"))
    assert resume.split()[-1] == "--detach"
    assert Run.open(run).n == 40 * N

    assert cli.run(["cancel", "--head"]) == 0
    assert running_head() is None and not Path(head.folder).exists()
    assert not [p for p in psutil.process_iter() if _group_of(p) == head.group]
    assert cli.run(["cancel", "--head"]) == 0
    assert "none runs" in capsys.readouterr().out


def _driver_lines(run: Path, capture: pytest.CaptureFixture[str]) -> list[str]:
    assert cli.run(["logs", str(run), "--driver", "--follow"]) == 0
    return capture.readouterr().out.splitlines()


def _group_of(process: psutil.Process) -> int:
    try:
        return os.getpgid(process.pid)
    except ProcessLookupError:
        return 0


def test_a_cluster_that_is_not_there_is_refused_and_nothing_is_written(
    state: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for address in ("http://127.0.0.1:9", "127.0.0.1:9", "nonsense"):
        arguments = ["submit", "heuristic", "--n", "8", "--out", str(tmp_path / "run"), "--detach"]
        refused([*arguments, "--address", address], capsys, "--address", address)
    assert list(tmp_path.iterdir()) == []

"""A job handed over to a real Ray head: it goes on when its shell is killed, and answers other shells."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import psutil
import pytest

from datagen import cli
from datagen.cluster.ray_head import running_head
from datagen.cluster.ray_jobs import open_ray_jobs
from datagen.schemas.jobs import Jobs
from datagen.schemas.run import Run
from datagen.schemas.storage import open_storage
from tests.datagen.jobs.conftest import Detached, N
from tests.refusals import refused
from tests.small_runs import arrays_of, assert_equal_runs, json_of, make_small_run

pytestmark = pytest.mark.slow


def test_a_detached_job_outlives_its_shell_and_is_followed_from_another(
    detached: Detached, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, shell, out = detached.run, detached.shell, detached.out
    told = "".join(out.split())  # a long path is broken into lines
    assert f"datagenstatus{run}" in told and "datagencancel" in told
    try:
        os.killpg(shell.pid, signal.SIGKILL)
    except ProcessLookupError:
        pass  # nothing of it is left, which is as good

    # What stays listens on loopback, wants a token, and its file is the user's alone.
    head = running_head()
    assert head is not None and (detached.state / "head.json").stat().st_mode & 0o777 == 0o600
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
    assert_equal_runs(arrays_of(run), arrays_of(make_small_run(tmp_path / "here", N)))

    # The same head takes the next one, which another shell stops.
    assert cli.run(["resume", str(run), "--n", str(160 * N), "--workers", "1", "--detach"]) == 0
    capsys.readouterr()
    assert running_head() == head and Run.open(run).n == 160 * N
    while len(jobs.all()) < 2:
        time.sleep(0.1)
    refused(["cancel", "--head"], capsys, "1 job running", "resume")
    assert cli.run(["cancel", str(run), "--now"]) == 0
    assert "ended interrupted" in capsys.readouterr().out
    output = open_ray_jobs(head.jobs_api, head.token).output(jobs.all()[1].record.submission)
    resume = next(line for line in output.splitlines() if line.strip().startswith("datagen resume"))
    assert resume.split() == ["datagen", "resume", str(run), "--detach"]


def _group_of(process: psutil.Process) -> int:
    try:
        return os.getpgid(process.pid)
    except ProcessLookupError:
        return 0


def test_a_cluster_that_is_not_there_is_refused_and_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DATAGEN_STATE", str(tmp_path / "state"))
    for address in ("http://127.0.0.1:9", "127.0.0.1:9", "nonsense"):
        arguments = ["submit", "heuristic", "--n", "8", "--out", str(tmp_path / "run"), "--detach"]
        refused([*arguments, "--address", address], capsys, "--address", address)
    assert list(tmp_path.iterdir()) == []

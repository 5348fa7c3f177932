"""`datagen cancel` and `status` from another process than the one that works."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from datagen import cli
from datagen.schemas.jobs import Jobs, StoredJob
from datagen.schemas.storage import open_storage
from tests.conftest import REPOSITORY
from tests.refusals import refused
from tests.small_runs import PER_SCENE, json_of, submit_arguments

pytestmark = pytest.mark.slow

N = 64 * PER_SCENE  # eight shards


class Work:
    """A job in a process of its own."""

    def __init__(self, run: Path) -> None:
        self.place = open_storage(run)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "datagen.cli", *submit_arguments(run, N)],
            cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def job(self) -> StoredJob:
        (job,) = Jobs(self.place).all()
        return job

    def wait_until_it_makes_shards(self) -> StoredJob:
        while True:
            jobs = Jobs(self.place).all()
            if jobs and jobs[0].state is not None and jobs[0].state.phase == "making":
                return jobs[0]
            assert self.process.poll() is None, self.process.communicate()
            time.sleep(0.05)


def test_another_process_sees_and_stops_a_job(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run"
    work = Work(run)
    seen = work.wait_until_it_makes_shards()
    assert seen.health() == "live" and seen.record.pid == work.process.pid
    assert cli.run(["status", str(run)]) == 0
    assert seen.id in (told := capsys.readouterr().out) and "labels/s" in told
    assert cli.run(["cancel", str(run)]) == 0
    told = capsys.readouterr()
    assert "ended interrupted, exit code 130" in told.out and f"datagen resume {run}" in told.out
    assert "asked to stop" in told.err  # the wait shows what it waits for
    assert work.process.wait(800) == 130
    job = work.job()
    assert job.health() == "ended" and job.state is not None and job.state.in_flight == 0
    (shown,) = json_of(capsys, ["status", str(run)])["jobs"]
    assert (shown["health"], shown["asked_to_stop"], shown["state"]["exit_code"]) == ("ended", "drain", 130)
    capsys.readouterr()
    assert cli.run(["status", str(run), "--log", "--json"]) == 0
    events = json.loads(capsys.readouterr().out)["events"]
    assert [e["event"] for e in events] == ["job_began", "job_ended"]
    assert cli.run(["cancel", str(run)]) == 0
    assert "none is running" in capsys.readouterr().out


def test_cancel_does_not_wait_for_a_killed_job(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run"
    work = Work(run)
    job = work.wait_until_it_makes_shards()
    work.process.kill()
    assert work.process.wait(800) == -signal.SIGKILL
    # A minute passes.
    assert job.state is not None
    before = (datetime.now(UTC) - timedelta(minutes=2)).isoformat()
    Jobs(work.place).put_state(job.state.model_copy(update={"updated": before}))
    (shown,) = json_of(capsys, ["status", str(run)])["jobs"]
    assert shown["health"] == "dead"
    assert cli.run(["status", str(run)]) == 0
    assert "dead: its process has ended" in capsys.readouterr().out
    assert cli.run(["cancel", str(run)]) == 0
    assert "none is running" in capsys.readouterr().out
    assert cli.run(["status", str(run), "--log"]) == 0
    assert "is dead: its process has ended" in capsys.readouterr().out


def test_cancel_gives_up_on_a_live_job_that_does_not_answer(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    work = Work(run)
    job = work.wait_until_it_makes_shards()
    work.process.send_signal(signal.SIGSTOP)
    try:
        before = (datetime.now(UTC) - timedelta(minutes=5)).isoformat()
        assert job.state is not None
        Jobs(work.place).put_state(job.state.model_copy(update={"updated": before}))
        monkeypatch.setattr("datagen.commands.cancel._GIVE_UP_S", 1.0)
        assert work.job().health() == "live"
        assert cli.run(["cancel", str(run)]) == 1
        told = capsys.readouterr()
        (line,) = [line for line in told.err.splitlines() if "has not ended" in line]
        assert (
            job.id in line and "its last sign was 5 min" in line and f"kill -9 {work.process.pid} on" in line
        )
        assert f"datagen resume {run}" in line and "Resume with" not in told.out
    finally:
        work.process.send_signal(signal.SIGCONT)
    assert work.process.wait(800) == 130  # the request stands


def test_cancel_asks_a_silent_job_of_another_host_without_waiting(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from tests.made_runs import make_run
    from tests.schemas.test_jobs import record_of

    place = make_run(tmp_path / "run", n=10).storage
    record = record_of(datetime.now(UTC) - timedelta(hours=3), 17, "another-host")
    Jobs(place).begin(record)
    assert cli.run(["cancel", str(tmp_path / "run")]) == 1
    assert "silent, last sign 3 h 0 min ago" in capsys.readouterr().out
    assert Jobs(place).stop_of(record.id) == "drain"


def test_cancel_does_not_wait_for_a_job_whose_clock_was_ahead(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from tests.made_runs import make_run
    from tests.schemas.test_jobs import NOBODY, record_of

    place = make_run(tmp_path / "run", n=10).storage
    Jobs(place).begin(record_of(datetime.now(UTC) + timedelta(days=1100), NOBODY))
    assert cli.run(["cancel", str(tmp_path / "run")]) == 0
    assert "none is running" in capsys.readouterr().out
    assert cli.run(["verify", str(tmp_path / "run"), "--clean"]) == 0


def test_cancel_refuses_a_folder_without_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for verb in ("cancel", "status"):
        refused([verb, str(tmp_path)], capsys, "not a run")
    assert list(tmp_path.iterdir()) == []

"""A job in a process of its own: it goes on when its shell is killed, and answers other shells."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from datagen import cli
from datagen.jobs.detach import detach_job
from datagen.schemas.errors import InputError
from datagen.schemas.jobs import Jobs
from datagen.schemas.run import Run
from datagen.schemas.storage import open_storage
from tests.conftest import REPOSITORY
from tests.small_runs import (
    HERE,
    PER_SCENE,
    arrays_of,
    assert_equal_runs,
    json_of,
    make_small_run,
    submit_arguments,
)

N = 2 * PER_SCENE


def test_a_detached_job_outlives_its_shell_and_is_followed_from_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    shell = subprocess.Popen(
        [sys.executable, "-m", "datagen.cli", *submit_arguments(run, N), "--detach"],
        cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    out, err = shell.communicate(timeout=600)
    assert shell.returncode == 0, err
    with suppress(ProcessLookupError):  # nothing of it is left, which is as good
        os.killpg(shell.pid, signal.SIGKILL)
    told = "".join(out.split())  # a long path is broken into lines
    assert f"datagenstatus{run}" in told and "datagencancel" in told
    jobs = Jobs(open_storage(run))
    while not (found := jobs.all()) or found[0].health() != "ended":
        time.sleep(0.2)
    assert str(found[0].record.pid) in out and found[0].record.pid != shell.pid
    report = json_of(capsys, ["status", str(run)])
    assert report["complete"] and report["sealed"] and report["jobs"][0]["state"]["exit_code"] == 0
    assert_equal_runs(arrays_of(run), arrays_of(make_small_run(tmp_path / "here", N)))

    # Another shell stops the next one.
    assert cli.run(["resume", str(run), "--n", str(160 * N), *HERE, "--detach"]) == 0
    told = capsys.readouterr().out
    assert Run.open(run).n == 160 * N
    while len(jobs.all()) < 2:
        time.sleep(0.1)
    assert cli.run(["cancel", str(run), "--now"]) == 0
    assert "ended interrupted" in capsys.readouterr().out
    (output,) = (line.split()[-1] for line in told.splitlines() if line.startswith("output"))
    assert f"datagen resume {run}" in "".join(Path(output).read_text().splitlines())


def test_a_command_that_ends_at_once_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("datagen.jobs.detach._BEGUN_WITHIN_S", 300.0)
    with pytest.raises(InputError, match=r"ended at once: .*no such folder"):
        detach_job(["status", str(tmp_path / "none")], str(tmp_path / "none"))

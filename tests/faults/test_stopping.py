"""A job that is interrupted, interrupted twice, or killed: what is committed stays, the rest resumes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from datagen.schemas.run import Run
from datagen.schemas.run_records import AttemptStart
from tests.made_runs import make_run

REPOSITORY = Path(__file__).resolve().parents[2]
SHARDS = 12  # five samples a scene, two scenes a shard


class Job:
    """The program of tests/faults/job.py, in a process group of its own, as a shell would start it."""

    def __init__(self, run: Run, seconds: float) -> None:
        self.run = run
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.faults.job", run.storage.url, str(seconds)],
            cwd=REPOSITORY,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def wait_until_committed(self, shards: int) -> None:
        while len(self.run.committed()) < shards:
            assert self.process.poll() is None, self.process.communicate()
            time.sleep(0.05)

    def wait_until_it_drains(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            # Where another program starts Ray at the same time, a line of text says so first.
            if line.startswith("{") and json.loads(line)["event"] == "stopping":
                return
        raise AssertionError("the job ended without draining")

    def ctrl_c(self) -> None:
        """What a terminal does: the signal goes to every process of the group."""
        os.killpg(self.process.pid, signal.SIGINT)

    def end(self) -> tuple[int, dict[str, Any]]:
        out, err = self.process.communicate(timeout=800)
        assert "Traceback" not in err
        return self.process.returncode, json.loads(out) if out else {}


def new_run(folder: Path) -> Run:
    return make_run(folder / "run", n=SHARDS * 10, shards=())


def unfinished(run: Run) -> list[AttemptStart]:
    return run.ledger.unfinished({commit.attempt for commit in run.commits()})


def test_one_ctrl_c_lets_what_is_in_flight_commit(tmp_path: Path) -> None:
    run = new_run(tmp_path)
    job = Job(run, 0.2)
    job.wait_until_committed(2)
    job.ctrl_c()
    code, said = job.end()
    assert code == 130 and said["end"] == "interrupted"
    assert set(said["outcomes"]) == {"committed"}  # workers did not die of the terminal's signal
    assert 2 <= len(run.committed()) < SHARDS and unfinished(run) == []


def test_two_ctrl_c_end_it_at_once_and_kill_9_loses_nothing_that_was_committed(tmp_path: Path) -> None:
    run = new_run(tmp_path)
    job = Job(run, 300)
    while len(unfinished(run)) < 2:
        time.sleep(0.05)
    job.ctrl_c()
    job.wait_until_it_drains()
    job.ctrl_c()
    code, said = job.end()
    assert code == 130 and set(said["outcomes"]) == {"cancelled"}
    assert run.committed() == set() and unfinished(run) == []

    job = Job(run, 0.3)
    job.wait_until_committed(3)
    job.process.kill()
    assert job.end()[0] == -signal.SIGKILL
    assert run.committed() != set(range(SHARDS))

    code, said = Job(run, 0).end()
    assert code == 0 and said["end"] == "complete"
    assert run.committed() == set(range(SHARDS)) and run.missing() == []
    assert unfinished(run) == []

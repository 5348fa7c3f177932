"""A raylet or GCS server that is killed or stopped: jobs complete or end in one line, without blame."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil
import pytest

from datagen.cluster.ray_settings import new_token
from datagen.schemas.jobs import Jobs
from datagen.schemas.run import Run
from tests.faults.server_campaign import check_bytes_and_ledger, kill_servers
from tests.faults.test_ray_processes import REPOSITORY, kill_machine, ray_start
from tests.made_runs import make_run
from tests.small_runs import submit_arguments

pytestmark = pytest.mark.slow


class Ended(NamedTuple):
    """How a program ended: its exit code and what it printed."""

    code: int
    out: str
    err: str


# Two slots that take a second a shard are at work for longer than a server may be silent.
SHARDS, PATIENCE_S = 24, "3"


@pytest.mark.parametrize("kind", ["raylet", "gcs_server", "stopped gcs_server"])
def test_a_local_cluster_that_dies_is_started_anew(tmp_path: Path, kind: str) -> None:
    seen = kill_servers(tmp_path, kind, kills=1, shards=8, seconds=0.5, rng=np.random.default_rng(0))
    assert seen["jobs aborted"] == 0 and seen["attempts wasted"] <= 4


@dataclass
class Joined:
    """A cluster of one machine, to be joined by its address, and the environment of its clients."""

    address: str
    environment: dict[str, str]
    machine: psutil.Process

    def server(self, kind: str) -> psutil.Process:
        (server,) = [p for p in self.machine.children(recursive=True) if p.name() == kind]
        return server


@pytest.fixture
def joined(tmp_path: Path) -> Iterator[Joined]:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")} | {
        "PYTHONPATH": str(REPOSITORY),
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": new_token(),
    }
    session = Path(tempfile.mkdtemp(prefix="dg"))  # short: sockets below it have at most 107 characters
    head = ("--head", "--node-ip-address=127.0.0.5", "--port=0", "--num-cpus=2", "--include-dashboard=false")
    machine = ray_start(tmp_path / "head", environment, *head, f"--temp-dir={session}")
    try:
        yield Joined((session / "ray_current_cluster").read_text().strip(), environment, machine)
    finally:
        tree = machine.children(recursive=True)
        kill_machine(machine)
        for process in tree:
            if process.is_running():
                process.kill()
        psutil.wait_procs(tree, timeout=60)
        shutil.rmtree(session, ignore_errors=True)


def ended(command: list[str], cluster: Joined, is_due: Callable[[], bool], harm: Callable[[], None]) -> Ended:
    """Run a job on the cluster, do `harm` when it is due, and return how the job ended."""
    job = subprocess.Popen(
        command, cwd=REPOSITORY, env=cluster.environment,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    while not is_due():
        assert job.poll() is None, job.communicate()
        time.sleep(0.05)
    harm()
    out, err = job.communicate(timeout=800)
    assert "Traceback" not in err and "rpc_client" not in err and "Unhandled" not in err, err
    return Ended(job.returncode, out, err)


@pytest.mark.parametrize("kind", ["raylet", "gcs_server"])
def test_a_cluster_of_others_that_dies_ends_the_job_and_leaves_its_shards_open(
    tmp_path: Path, kind: str, joined: Joined
) -> None:
    run = make_run(tmp_path / "run", n=SHARDS * 10, shards=())
    command = [sys.executable, "-m", "tests.faults.job", run.storage.url]
    words = [*command, "1.0", joined.address, PATIENCE_S]
    job = ended(words, joined, lambda: len(run.committed()) >= 3, joined.server(kind).kill)
    assert job.code == 2, job.err
    said = json.loads(job.out)
    assert said["end"] == "aborted" and said["cause"] and "\n" not in said["cause"]
    assert run.quarantined() == set() and run.missing()
    resumed = subprocess.run([*command, "0"], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert resumed.returncode == 0, resumed.stderr
    check_bytes_and_ledger(run)


def test_a_stopped_server_keeps_no_submit_at_its_end(tmp_path: Path, joined: Joined) -> None:
    """Connections to it are accepted by the kernel, and requests are never answered."""
    out = tmp_path / "run"
    words = submit_arguments(out, 64_000, "--address", joined.address, workers=2)
    command = [sys.executable, "-m", "datagen.cli", *words]
    job = ended(command, joined, lambda: any(out.glob("commits/*.json")), joined.server("gcs_server").suspend)
    last = job.err.splitlines()[-1]
    assert job.code == 2 and job.out == "", job.err
    assert last.startswith("error: ") and "GCS server" in last and "does not respond" in last, job.err
    assert "does not disconnect within" in job.err
    run = Run.open(out)
    assert run.quarantined() == set() and run.missing()
    assert [job.health() for job in Jobs(run.storage).all()] == ["ended"]

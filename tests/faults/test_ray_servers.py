"""A raylet or a GCS server that is killed: jobs complete or end in one line, and no shard is to blame."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from datagen.cluster.ray_settings import new_token
from tests.faults.server_campaign import check_bytes_and_ledger, kill_servers
from tests.faults.test_ray_processes import REPOSITORY, kill_machine, ray_start
from tests.made_runs import make_run

pytestmark = pytest.mark.slow

# Two slots that take a second a shard are at work for longer than a server may be silent.
SHARDS, PATIENCE_S = 24, "3"


@pytest.mark.parametrize("kind", ["raylet", "gcs_server"])
def test_a_local_cluster_that_dies_is_started_anew(tmp_path: Path, kind: str) -> None:
    seen = kill_servers(tmp_path, kind, kills=1, shards=8, seconds=0.5, rng=np.random.default_rng(0))
    assert seen["jobs aborted"] == 0 and seen["attempts wasted"] <= 4


@pytest.mark.parametrize("kind", ["raylet", "gcs_server"])
def test_a_cluster_of_others_that_dies_ends_the_job_and_leaves_its_shards_open(
    tmp_path: Path, kind: str
) -> None:
    run = make_run(tmp_path / "run", n=SHARDS * 10, shards=())
    environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")} | {
        "PYTHONPATH": str(REPOSITORY),
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": new_token(),
    }
    session = Path(tempfile.mkdtemp(prefix="dg"))  # short: sockets below it have at most 107 characters
    head = ("--head", "--node-ip-address=127.0.0.5", "--port=0", "--num-cpus=2", "--include-dashboard=false")
    machine = ray_start(tmp_path / "head", environment, *head, f"--temp-dir={session}")
    try:
        address = (session / "ray_current_cluster").read_text().strip()
        command = [sys.executable, "-m", "tests.faults.job", run.storage.url]
        job = subprocess.Popen(
            [*command, "1.0", address, PATIENCE_S], cwd=REPOSITORY, env=environment,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        while len(run.committed()) < 3:
            assert job.poll() is None, job.communicate()
            time.sleep(0.05)
        (server,) = [p for p in machine.children(recursive=True) if p.name() == kind]
        server.kill()
        out, err = job.communicate(timeout=800)
    finally:
        tree = machine.children(recursive=True)
        kill_machine(machine)
        for process in tree:
            if process.is_running():
                process.kill()
        psutil.wait_procs(tree, timeout=60)
        shutil.rmtree(session, ignore_errors=True)
    assert job.returncode == 2 and "Traceback" not in err and "rpc_client" not in err, err
    said = json.loads(out)
    assert said["end"] == "aborted" and said["cause"] and "\n" not in said["cause"]
    assert run.quarantined() == set() and run.missing()
    resumed = subprocess.run([*command, "0"], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert resumed.returncode == 0, resumed.stderr
    check_bytes_and_ledger(run)

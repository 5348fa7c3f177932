"""A cluster of programs with addresses of their own, as on real machines: joined by address and token."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest

from datagen.cluster.ray_settings import OBJECT_STORE_BYTES, new_token
from tests.faults.counted import check_rows
from tests.made_runs import make_run
from tests.s3_servers import free_port

pytestmark = pytest.mark.slow

REPOSITORY = Path(__file__).resolve().parents[2]
SHARDS = 12


@dataclass
class Cluster:
    """A head without slots at 127.0.0.2 and two machines of one slot at .3 and .4."""

    address: str
    environment: Mapping[str, str]
    token: str
    second: psutil.Process


def ray_start(said: Path, environment: Mapping[str, str], *arguments: str) -> psutil.Process:
    """`ray start` that stays; its whole tree of processes is the machine. What it says goes to a file."""
    shared = [
        *("--block", "--disable-usage-stats", f"--object-store-memory={OBJECT_STORE_BYTES}"),
        # Ray gives each machine the same ports by default, and these are one machine.
        *("--dashboard-agent-listen-port=0", "--metrics-export-port=0"),
    ]
    command = [sys.executable, "-m", "ray.scripts.scripts", "start", *shared, *arguments]
    for _ in range(3):  # Ray gives up after 30 s, which a busy machine may need
        with said.open("w") as output:
            machine = psutil.Popen(
                command, env=environment, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
            )
        while machine.poll() is None:
            if "will now block forever" in said.read_text():  # said once the address is in its file
                return machine
            time.sleep(0.1)
    raise AssertionError(said.read_text())


def kill_machine(machine: psutil.Process) -> None:
    """SIGKILL to all of its processes, as when the power goes."""
    tree = [machine, *machine.children(recursive=True)]
    for process in tree:
        with suppress(psutil.NoSuchProcess):  # one may end between the list and the signal
            process.kill()
    psutil.wait_procs(tree, timeout=60)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    folder = tmp_path_factory.mktemp("cluster")
    token, token_file = new_token(), folder / "token"
    token_file.write_text(token + "\n")
    token_file.chmod(0o600)
    environment = {
        **{name: value for name, value in os.environ.items() if not name.startswith("RAY_")},
        "HOME": str(folder),
        "PYTHONPATH": str(REPOSITORY),
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN_PATH": str(token_file),
        # A machine that is gone is noticed within two seconds instead of twenty.
        "RAY_health_check_period_ms": "500",
        "RAY_health_check_failure_threshold": "3",
    }
    session = Path(tempfile.mkdtemp(prefix="dg"))  # short: sockets below it have at most 107 characters
    machines: list[psutil.Process] = []
    try:
        head = (
            *("--head", "--node-ip-address=127.0.0.2", "--port=0", "--num-cpus=0"),
            *("--include-dashboard=false", f"--temp-dir={session}"),
            f"--ray-client-server-port={free_port()}",
        )
        machines.append(ray_start(folder / "head", environment, *head))
        address = (session / "ray_current_cluster").read_text().strip()
        for name, last in (("first", 3), ("second", 4)):
            joining = (f"--address={address}", f"--node-ip-address=127.0.0.{last}", "--num-cpus=1")
            machines.append(ray_start(folder / name, environment, *joining))
        yield Cluster(address, environment, token, machines[2])
    finally:
        for machine in machines:
            if machine.is_running():
                kill_machine(machine)
        shutil.rmtree(session, ignore_errors=True)


def test_a_job_outlives_a_machine_whose_power_goes(cluster: Cluster, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", n=SHARDS * 10, shards=())
    job = subprocess.Popen(
        [sys.executable, "-m", "tests.faults.job", run.storage.url, "1.0", cluster.address],
        cwd=REPOSITORY,
        env=cluster.environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    while len(run.committed()) < 2 or len(run.ledger.unfinished(())) < 2:  # both machines are at work
        assert job.poll() is None, job.communicate()
        time.sleep(0.05)
    kill_machine(cluster.second)
    out, err = job.communicate(timeout=800)
    assert job.returncode == 0 and "Traceback" not in err, err
    said = json.loads(out)
    assert said["end"] == "complete" and said["closed"] == 0 and said["outcomes"]["committed"] == SHARDS
    assert set(said["outcomes"]) <= {"committed", "lost"}
    check_rows(run, list(run.commits()))

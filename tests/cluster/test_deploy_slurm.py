"""The batch script run for real: two machines at loopback addresses, Slurm's two programs stood in for.

`srun` and `scontrol` are replaced by a few lines of shell that do what they do as far as the script can
see: run a command on a named machine, list the machines, note a request to be queued again.
"""

from __future__ import annotations

import os
import shutil
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from datagen import cli
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from tests.small_runs import CONFIG

pytestmark = pytest.mark.slow

SCRIPT = Path(__file__).resolve().parents[2] / "datagen" / "cluster" / "deploy" / "slurm" / "datagen.sbatch"
# A machine is its loopback address; Ray would give both the same port for an agent.
SRUN = """#!/usr/bin/env bash
while [[ "$1" == --* ]]; do
    case "$1" in --nodelist=*) host=${1#*=} ;; esac
    shift
done
declare -A addresses=([alpha]=127.0.0.2 [beta]=127.0.0.3)
address=${addresses[$host]}
if [[ "$*" == *"hostname --ip-address"* ]]; then
    printf '::1 127.0.1.1\\n%s fd00::2\\n' "$address"
else
    echo "$host: $*" >> "$SLURM_SUBMIT_DIR/started"
    exec "$@" --dashboard-agent-listen-port=0
fi
"""
SCONTROL = """#!/usr/bin/env bash
case "$1" in
    show) [ "$2 $3" = "hostnames [alpha-beta]" ] && printf '%s\\n' alpha beta ;;
    requeue) echo "$2" >> "$SLURM_SUBMIT_DIR/requeued" ;;
esac
"""


def words_of(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.Error:
        return []


def committed(place: Path) -> int:
    try:
        return len(Run.open(place).committed())
    except InputError:
        return 0  # not yet a run


def test_the_batch_script_computes_stops_for_preemption_and_is_queued_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    programs = tmp_path / "bin"
    programs.mkdir()
    for name, text in (("srun", SRUN), ("scontrol", SCONTROL)):
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    (tmp_path / "small.toml").write_text(CONFIG)
    here, run = tmp_path / "submitted", tmp_path / "run"
    here.mkdir()
    job_id = str(os.getpid())
    environment = {
        **{name: value for name, value in os.environ.items() if not name.startswith("RAY_")},
        "PATH": os.pathsep.join([str(programs), str(Path(sys.executable).parent), os.environ["PATH"]]),
        "SLURM_JOB_ID": job_id,
        "SLURM_JOB_NODELIST": "[alpha-beta]",
        "SLURM_CPUS_PER_TASK": "1",
        "SLURM_SUBMIT_DIR": str(here),
    }
    asked = ["heuristic", "--n", "768", "--out", str(run), "--candidates-per-scene", "8"]
    with (tmp_path / "output").open("w") as output:
        job = psutil.Popen(
            ["bash", SCRIPT, *asked, "--config", str(tmp_path / "small.toml")],
            env=environment,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    folders: set[Path] = set()
    try:
        while committed(run) == 0:
            assert job.poll() is None, (tmp_path / "output").read_text()
            time.sleep(0.1)
        (token,) = here.glob(".datagen-token-*")
        assert stat.S_IMODE(token.stat().st_mode) == 0o600 and len(token.read_text().strip()) == 64
        machines = job.children(recursive=True)
        folders = {
            Path(w.partition("=")[2]) for p in machines for w in words_of(p) if w.startswith("--temp_dir=")
        }
        # Ray opens its folder to everybody, so it lies in one that is closed.
        assert len(folders) == 2 and {stat.S_IMODE(f.parent.stat().st_mode) for f in folders} == {0o700}
        assert sum(process.name() == "raylet" for process in machines) == 2
        job.send_signal(signal.SIGTERM)
        code = job.wait(timeout=600)
    finally:
        for process in [*job.children(recursive=True), job] if job.is_running() else []:
            process.kill()
        for folder in folders:
            shutil.rmtree(folder.parent, ignore_errors=True)
    said = (tmp_path / "output").read_text()
    assert code == 130, said
    assert (here / "requeued").read_text().split() == [job_id]
    started = (here / "started").read_text()
    assert "alpha: bash -c exec ray start" in started and "beta: bash -c exec ray start" in started
    assert "0.0.0.0" not in started and "--include-dashboard=false" in started
    _, alive = psutil.wait_procs(machines, timeout=120)
    assert not token.exists() and not alive  # nothing is left behind on the machines
    made = committed(run)
    won = {commit.attempt for commit in Run.open(run).commits()}
    assert 0 < made < 8 and Run.open(run).ledger.unfinished(won) == []

    # What Slurm does next is the same command; here without a cluster, which changes no label.
    assert cli.run(["submit", *asked, "--config", str(tmp_path / "small.toml"), "--workers", "0"]) == 0
    assert committed(run) == 8

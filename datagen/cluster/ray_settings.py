"""Environment of Ray processes and of detached jobs: loopback address, token, and the shell's variables.

A detached job gets secrets in a file that only its user can read, since Ray shows a runtime environment on
command lines and in logs; the job's driver and workers read it when they start. This module does not import
Ray, so that it can be used to run `ray start` as a program."""

from __future__ import annotations

import json
import os
import secrets
import socket
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path

import datagen
from datagen.cluster.cluster_folders import OWNER

OBJECT_STORE_BYTES = 80 * 2**20  # only reports are sent, so the smallest size that Ray accepts

# Environment of every worker process, on any machine.
WORKER_ENVIRONMENT = {"OMP_NUM_THREADS": "1"}  # a slot is one core

_LOCAL = {
    "RAY_USAGE_STATS_ENABLED": "0",
    # Makes Ray listen on loopback only. Read when Ray is imported.
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    # A busy machine needs longer than the 30 to 60 s that Ray gives its own processes.
    "RAY_gcs_server_port_wait_time_s": "300",
    "RAY_gcs_rpc_server_connect_timeout_s": "100",  # tried three times
    "RAY_worker_register_timeout_seconds": "300",
    "RAY_DASHBOARD_STARTUP_TIMEOUT_S": "300",
    # Whether the raylet learns from a pipe that its parent has exited.
    "RAY_enable_pipe_based_agent_to_parent_health_check": "1",
}


def import_root() -> Path:
    """The folder from which this process imports `datagen`."""
    return Path(datagen.__file__).resolve().parent.parent


def new_token() -> str:
    """A random token of 256 bits, which allows running code on the cluster."""
    return secrets.token_hex(32)


def head_environment(token: str, folder: Path | None = None) -> dict[str, str]:
    """Environment, added to the caller's, of a local cluster and its clients.

    The processes listen on loopback, require the token, and belong to a private folder. Workers find the
    package by PYTHONPATH, as the caller did.
    """
    paths = [str(import_root()), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {
        **_LOCAL,
        **WORKER_ENVIRONMENT,
        **token_environment(token),
        **({OWNER: str(folder)} if folder else {}),
        "PYTHONPATH": os.pathsep.join(dict.fromkeys(paths)),
    }


def token_environment(token: str) -> dict[str, str]:
    """Environment with which Ray requires and sends this token.

    RAY_AUTH_TOKEN_PATH is emptied, so that there is only one source of the token.
    """
    return {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": token, "RAY_AUTH_TOKEN_PATH": ""}


def head_arguments(workers: int) -> list[str]:
    """Arguments of `ray` to start the head of a local cluster, with dashboard and jobs.

    Port 0 selects a free one, which Ray prints. Use with `head_environment`, without which Ray would listen
    on every interface.
    """
    return [
        "start",
        "--head",
        "--node-ip-address=127.0.0.1",
        "--port=0",
        "--include-dashboard=true",
        "--dashboard-host=127.0.0.1",
        "--dashboard-port=0",
        "--dashboard-agent-listen-port=0",
        # Fixed by default: two heads on one machine would share the port and each other's clients.
        f"--ray-client-server-port={free_port()}",
        f"--num-cpus={workers}",
        f"--object-store-memory={OBJECT_STORE_BYTES}",
        "--disable-usage-stats",
    ]


def free_port() -> int:
    """A free port of the loopback address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


# Path of the file, for a detached job.
JOB_ENVIRONMENT = "DATAGEN_JOB_ENVIRONMENT"
# Name of the thread that disconnects from Ray. Where it is left behind, the interpreter's end would wait too.
ENDING_RAY = "ending Ray"
_OF_THE_SHELL = ("AWS_", "DATAGEN_", "XDG_CACHE_HOME")


def is_of_the_shell(name: str) -> bool:
    """Whether a detached job gets this variable from the submitting shell, not from Ray's head."""
    return name.startswith(_OF_THE_SHELL)


def adopt_job_environment() -> None:
    """Set the variables of a detached job; Ray calls it in each worker of the job."""
    if named := os.environ.get(JOB_ENVIRONMENT):
        os.environ.update(json.loads(Path(named).read_text()))


@contextmanager
def job_environment() -> Generator[None]:
    """Set the variables of a detached job, and remove their file when the block ends."""
    adopt_job_environment()
    try:
        yield
    finally:
        if named := os.environ.get(JOB_ENVIRONMENT):
            Path(named).unlink(missing_ok=True)


@contextmanager
def changed_environment(values: Mapping[str, str | None]) -> Generator[None]:
    """Set variables, or unset those that are None, and restore all when the block ends."""
    before = {name: os.environ.get(name) for name in values}
    _set(values)
    try:
        yield
    finally:
        _set(before)


def _set(values: Mapping[str, str | None]) -> None:
    for name, value in values.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value

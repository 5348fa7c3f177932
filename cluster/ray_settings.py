"""What Ray processes are started with: environment and options, on the loopback address, with a token.

Nothing here imports Ray, so that whoever starts `ray start` as a program can use it.
"""

from __future__ import annotations

import os
import secrets
import socket
from pathlib import Path

import datagen
from datagen.cluster.private_folder import OWNER

OBJECT_STORE_BYTES = 80 * 2**20  # only reports travel, so the least that Ray accepts

# What every worker process needs, on whatever machine it starts.
WORKER_ENVIRONMENT = {"OMP_NUM_THREADS": "1"}  # a slot is one core

_LOCAL = {
    "RAY_USAGE_STATS_ENABLED": "0",
    # A cluster of one machine: Ray then listens on the loopback address alone. Read when Ray is imported.
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    # A busy machine needs longer than the 30 to 60 s that Ray gives its own processes.
    "RAY_gcs_server_port_wait_time_s": "300",
    "RAY_worker_register_timeout_seconds": "300",
    # Whether a process lives as long as the raylet is told by a pipe.
    "RAY_enable_pipe_based_agent_to_parent_health_check": "1",
}


def import_root() -> Path:
    """The folder from which this process imports `datagen`."""
    return Path(datagen.__file__).resolve().parent.parent


def new_token() -> str:
    """A random token of 256 bits: who has it may run code on the cluster."""
    return secrets.token_hex(32)


def head_environment(token: str, folder: Path | None = None) -> dict[str, str]:
    """Environment, over the caller's own, of a cluster of this machine alone and of its clients.

    The processes listen on the loopback address, answer only those who have the token, and belong to a
    private folder. Workers find the package by PYTHONPATH, wherever the caller found them.
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
    """Environment with which Ray asks for this token, and gives it.

    RAY_AUTH_TOKEN_PATH is emptied: of two sources Ray would take the first, and a reader the other.
    """
    return {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": token, "RAY_AUTH_TOKEN_PATH": ""}


def head_arguments(workers: int) -> list[str]:
    """Arguments of `ray` that start the head of a cluster of this machine, with dashboard and jobs.

    Port 0 takes a free one; Ray says which on its standard output. Use with `head_environment`,
    without which Ray would listen on every interface.
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
        # Fixed by default: two heads on one machine would share the port, and each other's clients.
        f"--ray-client-server-port={free_port()}",
        f"--num-cpus={workers}",
        f"--object-store-memory={OBJECT_STORE_BYTES}",
        "--disable-usage-stats",
    ]


def free_port() -> int:
    """A port of the loopback address that nobody listens at now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])

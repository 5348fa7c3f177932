"""Environment of Ray processes: loopback address, token and numbers of threads."""

from __future__ import annotations

import os
import secrets
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


# Name of the thread that disconnects from Ray. Where it is left behind, the interpreter's end would wait too.
ENDING_RAY = "ending Ray"


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

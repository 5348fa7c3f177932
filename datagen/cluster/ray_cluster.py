"""Start a Ray cluster on this machine, or join a running one, with its token.

A local cluster listens on loopback and requires a random token. For a running one the token is taken from
where Ray looks for it, if the cluster requires one.
"""

from __future__ import annotations

import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Generator
from contextlib import ExitStack, chdir, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.cluster.cluster_folders import private_folder
from datagen.cluster.ray_settings import (
    ENDING_RAY,
    OBJECT_STORE_BYTES,
    changed_environment,
    head_environment,
    import_root,
    new_token,
    token_environment,
)
from datagen.schemas.errors import InputError

_PATIENCE_S = 10.0
_SILENT_START_S = 5.0  # then a message is printed
_TOKEN_FIX = (
    "Set RAY_AUTH_TOKEN to the token that the cluster was started with, or RAY_AUTH_TOKEN_PATH to its file"
)

_START_WITHIN_S, _END_WITHIN_S = 300.0, 20.0
_LOOK_S = 0.05
# Files in which the raylet expects the ports of its agents. Port 1 is never connected to.
_AGENT_PORTS = (
    "dashboard_agent_listen_port",
    "metrics_agent_port",
    "metrics_export_port",
    "runtime_env_agent_port",
)
# In place of an agent: it exits with the raylet, when its input ends.
_NO_AGENT = "/bin/cat"
_LOCAL_FIX = (
    "Start it again when the machine is less busy; use --workers 0, which needs no Ray, or the --address of "
    "a running cluster"
)
_START_FIX = "Start Ray there and give HOST:PORT, or use --address local"


@dataclass(frozen=True)
class RaySettings:
    """Address and size of a cluster."""

    address: str = "local"  # or `auto`, `HOST:PORT` of a running cluster
    workers: int | None = None  # slots of a local cluster, most of a running one; None: one per core
    attempts_per_worker: int = 200  # then a new process, because of memory leaks
    task_memory_bytes: int = 0  # that an attempt requests of a running cluster
    # Gets lines about machines of a running cluster: those that are left out, and none being free.
    tell: Callable[[str], None] = lambda line: None


@contextmanager
def ray_cluster(settings: RaySettings) -> Generator[Any]:
    """Start a local cluster, or connect to a running one, for the block; gives the module `ray`.

    A local cluster has a private folder and no dashboard. Raises InputError when it does not start, or when
    the running one cannot be reached or requires another token.
    """
    local = settings.address == "local"
    on_sigterm = signal.getsignal(signal.SIGTERM)
    with ExitStack() as whole, ExitStack() as start:
        if local:
            address, folder = "local", whole.enter_context(private_folder())
            wanted = head_environment(new_token(), folder)
            options: dict[str, Any] = {
                "num_cpus": settings.workers,
                "include_dashboard": False,
                "object_store_memory": OBJECT_STORE_BYTES,
            }
        else:
            address = _resolved(settings.address)
            wanted, options = head_environment("") | token_for(address), {}
        start.enter_context(changed_environment(wanted))  # workers inherit it; the caller's is restored
        import ray
        from ray.exceptions import AuthenticationError, RaySystemError

        _keep_ray_local()
        forget_former_token()
        if local:
            start.enter_context(slim_node())
        start.enter_context(_announced(f"waiting for Ray to start: --address {settings.address}\n"))
        try:
            # Ray puts the working directory first on the workers' sys.path, and a user's may hold a train.py.
            with chdir(import_root()):
                ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **options)
        except InputError:
            raise
        except (OSError, RuntimeError, ValueError, AuthenticationError, RaySystemError) as error:
            raise _refusal(settings.address, error) from error
        start.close()
        _handle_sigterm(on_sigterm)  # else Ray's machine code takes it for a crash, and aborts
        # Private: Ray prints a paragraph for each dead worker; the driver reports it already.
        ray._private.worker._worker_logs_enabled = False  # pyright: ignore
        ray._private.worker._unhandled_error_handler = lambda error: None  # pyright: ignore
        ending = threading.Thread(target=ray.shutdown, daemon=True, name=ENDING_RAY)
        whole.callback(_end, ending, settings.tell)
        yield ray
    if local:  # without its servers, which are killed now, Ray ends
        ending.join(_END_WITHIN_S)
    _handle_sigterm(on_sigterm)  # Ray removes it when it ends


def _handle_sigterm(handler: Any) -> None:
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)


def _end(ending: threading.Thread, tell: Callable[[str], None]) -> None:
    """Disconnect from Ray, which would wait for ever for a server that is stopped."""
    ending.start()
    ending.join(_END_WITHIN_S)
    if ending.is_alive():
        tell(f"Ray does not disconnect within {_END_WITHIN_S:g} s: a server of its cluster does not respond")


@contextmanager
def _announced(line: str) -> Generator[None]:
    """Print a line to standard error when the block takes longer than some seconds."""
    timer = threading.Timer(_SILENT_START_S, sys.stderr.write, [line])
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _refusal(address: str, error: BaseException) -> BaseException:
    """The InputError for an error of Ray while it starts or joins a cluster."""
    if address == "local":
        return InputError("ray", "", f"does not start: {first_line(error)}", _LOCAL_FIX)
    if not isinstance(error, RuntimeError):
        return InputError("--address", address, first_line(error), "Start Ray there, or use --address local")
    if "No node info found" not in str(error):
        return error
    problem = "no node of that cluster runs on this machine"
    fix = "Submit from one of its machines, or start a node here: ray start --address"
    return InputError("--address", address, problem, fix)


def refuse_unusable(address: str) -> None:
    """Raise InputError where no cluster responds, it refuses the known token, or none can be started here.

    Ray itself would retry for minutes, and without a loopback network for ever.
    """
    if address == "local":
        refuse_no_loopback()
    else:
        address = _resolved(address)
        refuse_unreachable(address)
        token_for(address)


def refuse_no_loopback() -> None:
    """Raise InputError where processes of this machine cannot connect to each other."""
    try:
        with socket.create_server(("127.0.0.1", 0)) as server:
            socket.create_connection(server.getsockname(), timeout=_PATIENCE_S).close()
    except OSError as error:
        fix = "Start it with `ip link set lo up`, or work in this process: --workers 0"
        raise InputError("--address", "local", f"the loopback network does not work ({error})", fix) from None


def refuse_unreachable(address: str) -> None:
    """Raise InputError where no server listens at HOST:PORT."""
    host, _, port = address.rpartition(":")
    if not host or not (port.isascii() and port.isdigit() and len(port) < 6):
        raise InputError("--address", address, "is not the address of a cluster", _START_FIX)
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=_PATIENCE_S).close()
    # A name that cannot be encoded is a ValueError, a port above 65535 an OverflowError.
    except (OSError, ValueError, OverflowError) as error:
        raise InputError("--address", address, f"cannot be reached ({error})", _START_FIX) from None


def token_for(address: str) -> dict[str, str]:
    """Environment of a client of the cluster at HOST:PORT.

    A token is sent only to a cluster that requires one. Raises InputError where none is set, or the cluster
    refuses it.
    """
    if not _refuses(address, None):
        return {"RAY_AUTH_MODE": "disabled"}
    found = known_token()
    if found is None:
        raise InputError("--address", address, "the cluster requires a token, but none is set", _TOKEN_FIX)
    token, origin = found
    if _refuses(address, token):
        raise InputError("--address", address, f"the cluster refuses the token in {origin}", _TOKEN_FIX)
    return token_environment(token)


def known_token() -> tuple[str, str] | None:
    """The token that Ray would use, and its origin: the environment, a file that it names, or ~/.ray."""
    if token := os.environ.get("RAY_AUTH_TOKEN", "").strip():
        return token, "RAY_AUTH_TOKEN"
    path = Path(os.environ.get("RAY_AUTH_TOKEN_PATH") or Path.home() / ".ray" / "auth_token")
    try:
        token = path.read_text().strip()
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, "", f"the token cannot be read ({error})", _TOKEN_FIX) from None
    return (token, str(path)) if token else None


def first_line(error: BaseException) -> str:
    """The first line of an error's text, without its full stop."""
    lines = str(error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__


def _resolved(address: str) -> str:
    """`auto` as the address in RAY_ADDRESS, which Ray sets for its jobs."""
    if address != "auto":
        return address
    if named := os.environ.get("RAY_ADDRESS", ""):
        return named
    raise InputError("--address", address, "RAY_ADDRESS names no cluster", _START_FIX)


def _refuses(address: str, token: str | None) -> bool:
    """Whether the cluster refuses a client with this token, or without one, by a request for its name."""
    import grpc

    headers = (("authorization", f"Bearer {token}"),) if token else ()
    with grpc.insecure_channel(address) as channel:
        request = channel.unary_unary("/ray.rpc.NodeInfoGcsService/GetClusterId")
        try:
            request(b"", timeout=_PATIENCE_S, metadata=headers)
        except grpc.RpcError as error:
            code = error.code()  # pyright: ignore[reportAttributeAccessIssue]
            if code == grpc.StatusCode.UNAUTHENTICATED:
                return True
            problem = f"responds, but not as a Ray cluster ({code.name.lower()})"
            raise InputError("--address", address, problem, _START_FIX) from None
    return False


def _keep_ray_local() -> None:
    """Make Ray use 127.0.0.1 instead of this machine's external address, and upload no code under `uv run`.

    And leave SIGTERM to the job, which ends with its message; Ray would exit with the signal's number.
    Private: Ray reads the first two from the environment, but only when it is imported, which may have been
    before.
    """
    from ray._private import ray_constants, utils

    utils.set_sigterm_handler = lambda sigterm_handler: None
    ray_constants.ENABLE_RAY_CLUSTER = False
    ray_constants.RAY_ENABLE_UV_RUN_RUNTIME_ENV = False


def forget_former_token() -> None:
    """Make Ray read its token again. Private: it caches token and mode for the whole process."""
    from ray._raylet import AuthenticationTokenLoader, Config  # pyright: ignore

    Config.initialize("")  # first: the loader checks whether a token is required
    AuthenticationTokenLoader.instance().reset_cache()


@contextmanager
def slim_node() -> Generator[None]:
    """Make Ray start local clusters with only the two native processes that run tasks, within the block.

    Ray normally also starts monitors and two agents in Python. They triple the time to start, take 400 MB,
    and outlive a killed driver; the raylet exits where an agent does not start within 15 s. A local job
    needs none of them: no runtime environments, no Jobs API, no metrics. Private: no option omits them.

    Inside it, `ray.init` raises InputError where the node does not start in five minutes.
    """
    from ray._private import node, services

    class SlimNode(node.Node):
        def start_head_processes(self) -> None:
            self.start_gcs_server()
            self._write_cluster_info_to_kv()

        def start_ray_processes(self) -> None:
            self._ray_params.update(include_log_monitor=False)
            for name in _AGENT_PORTS:
                Path(self._session_dir, f"{name}_{self._node_id}").write_text("1")
            start = services.start_ray_process
            services.start_ray_process = lambda command, *rest, **options: start(
                [_without_agent(word) for word in command], *rest, **options
            )
            try:
                super().start_ray_processes()
            finally:
                services.start_ray_process = start
            self._await_raylet()

        def _await_raylet(self) -> None:
            """Wait until the node is registered; Ray itself gives up after 30 s."""
            raylet: Any = self.all_processes["raylet"][0].process
            until_s = time.monotonic() + _START_WITHIN_S
            while True:
                try:
                    services.get_node(self.gcs_address, self._node_id)
                    return
                except RuntimeError:
                    if raylet.poll() is not None or time.monotonic() >= until_s:
                        break
                time.sleep(_LOOK_S)
            code = raylet.poll()
            why = f"not within {_START_WITHIN_S:g} s" if code is None else f"it ended with {code}"
            raise InputError("ray", "", f"does not start: {why}", _LOCAL_FIX)

    before = node.Node
    node.Node = SlimNode
    try:
        yield
    finally:
        node.Node = before


def _without_agent(word: str) -> str:
    option, equals, _ = word.partition("=")
    return f"{option}={_NO_AGENT}" if equals and option.endswith("_agent_command") else word

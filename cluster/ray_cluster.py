"""Starting a Ray cluster on this machine, or joining one that runs, and the token that goes with it.

A cluster that is started here listens on the loopback address alone and answers only those who know
its random token. A running one is asked whether it wants a token; it is looked for where Ray looks.
"""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cluster.environment import changed_environment
from cluster.ray_settings import OBJECT_STORE_BYTES, head_environment, new_token, token_environment
from schemas.errors import InputError

_PATIENCE_S = 10.0
_TOKEN_MEND = (
    "Set RAY_AUTH_TOKEN to the token that the cluster was started with, or RAY_AUTH_TOKEN_PATH to its file"
)
_START_MEND = "Start Ray there and give HOST:PORT, or use --address local"


@dataclass(frozen=True)
class RaySettings:
    """Where and how wide to run."""

    address: str = "local"  # or `auto`, `HOST:PORT`, `ray://...` of a running cluster
    workers: int | None = None  # slots of a local cluster; None is one a core
    attempts_per_worker: int = 500  # then a fresh process, against slow leaks
    resident_limit_bytes: int = 3 * 2**30  # above it after an attempt: a fresh process at once
    object_store_bytes: int = OBJECT_STORE_BYTES


@contextmanager
def ray_cluster(settings: RaySettings) -> Generator[Any]:
    """Start a local cluster, or connect to a running one, for the time of the block; gives `ray`.

    A local cluster opens no dashboard. Raises InputError when the cluster cannot be reached, or wants
    another token than is known here.
    """
    if settings.address == "local":
        wanted = head_environment(new_token())
        options: dict[str, Any] = {
            "num_cpus": settings.workers,
            "include_dashboard": False,
            "object_store_memory": settings.object_store_bytes,
        }
        address = "local"
    else:
        address = _resolved(settings.address)
        wanted = head_environment("") | token_for(address)
        options = {}
    with changed_environment(wanted):  # workers inherit it; the caller's own stays as it was
        import ray
        from ray.exceptions import AuthenticationError

        _keep_loopback()
        forget_former_token()
        try:
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **options)
        except (ConnectionError, ValueError, TimeoutError, AuthenticationError) as error:
            mend = "Start Ray there, or use --address local"
            raise InputError("--address", settings.address, first_line(error), mend) from error
        except RuntimeError as error:
            if "No node info found" not in str(error):
                raise
            problem = "no node of that cluster runs on this machine"
            mend = "Submit from one of its machines, or start a node here: ray start --address"
            raise InputError("--address", settings.address, problem, mend) from error
    # Ray prints a paragraph on standard output for each dead worker; the driver reports it already.
    ray._private.worker._worker_logs_enabled = False  # pyright: ignore
    try:
        yield ray
    finally:
        ray.shutdown()


def refuse_unusable(address: str) -> None:
    """Raise InputError where no cluster answers, or one that lets nobody in with the token known here.

    `local` passes. Ray itself tries for minutes, and with messages of its own.
    """
    if address != "local":
        address = _resolved(address)
        refuse_unreachable(address)
        token_for(address)


def refuse_unreachable(address: str) -> None:
    """Raise InputError where nothing listens at a `[ray://]HOST:PORT`."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not (port.isascii() and port.isdigit() and len(port) < 6):
        raise InputError("--address", address, "not the address of a cluster", _START_MEND)
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=_PATIENCE_S).close()
    # A name that cannot be encoded is a ValueError, a port above 65535 an OverflowError.
    except (OSError, ValueError, OverflowError) as error:
        raise InputError("--address", address, f"cannot be reached ({error})", _START_MEND) from None


def token_for(address: str) -> dict[str, str]:
    """Environment with which a client of the cluster at HOST:PORT is let in.

    A token is given only to a cluster that asks for one. Raises InputError where none is known here,
    or the one that is known is not the cluster's.
    """
    if address.startswith("ray://"):  # another protocol, which cannot be asked
        found = known_token()
        return token_environment(found[0]) if found else {"RAY_AUTH_MODE": "disabled"}
    if not _turns_away(address, None):
        return {"RAY_AUTH_MODE": "disabled"}
    found = known_token()
    if found is None:
        raise InputError("--address", address, "the cluster asks for a token, and none is set", _TOKEN_MEND)
    token, place = found
    if _turns_away(address, token):
        raise InputError("--address", address, f"the cluster refuses the token in {place}", _TOKEN_MEND)
    return token_environment(token)


def known_token() -> tuple[str, str] | None:
    """The token that Ray would find, and where: in the environment, a file that it names, or ~/.ray."""
    if token := os.environ.get("RAY_AUTH_TOKEN", "").strip():
        return token, "RAY_AUTH_TOKEN"
    path = Path(os.environ.get("RAY_AUTH_TOKEN_PATH") or Path.home() / ".ray" / "auth_token")
    try:
        token = path.read_text().strip()
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, "", f"the token cannot be read ({error})", _TOKEN_MEND) from None
    return (token, str(path)) if token else None


def first_line(error: BaseException) -> str:
    """The first line of an error's text, without its full stop."""
    lines = str(error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__


def _resolved(address: str) -> str:
    """`auto` as the HOST:PORT of the cluster that runs here."""
    if address != "auto":
        return address
    from ray._private.services import canonicalize_bootstrap_address_or_die

    _keep_loopback()
    try:
        return str(canonicalize_bootstrap_address_or_die("auto"))
    except ConnectionError as error:
        problem = "no Ray cluster runs on this machine, and RAY_ADDRESS names none"
        raise InputError("--address", address, problem, _START_MEND) from error
    except ValueError as error:
        raise InputError("--address", address, first_line(error), _START_MEND) from error


def _turns_away(address: str, token: str | None) -> bool:
    """Whether the cluster refuses a client with this token, or without one. Asks for the cluster's name."""
    import grpc

    headers = (("authorization", f"Bearer {token}"),) if token else ()
    with grpc.insecure_channel(address) as channel:
        ask = channel.unary_unary("/ray.rpc.NodeInfoGcsService/GetClusterId")
        try:
            ask(b"", timeout=_PATIENCE_S, metadata=headers)
        except grpc.RpcError as error:
            code = error.code()  # pyright: ignore[reportAttributeAccessIssue]
            if code == grpc.StatusCode.UNAUTHENTICATED:
                return True
            problem = f"answers, but not as a Ray cluster does ({code.name.lower()})"
            raise InputError("--address", address, problem, _START_MEND) from None
    return False


def _keep_loopback() -> None:
    """Let Ray take 127.0.0.1 as it is, and not for this machine's outer address.

    It reads that from the environment, but only once, when it is imported, which may have been before.
    """
    from ray._private import ray_constants

    ray_constants.ENABLE_RAY_CLUSTER = False


def forget_former_token() -> None:
    """Let Ray read its environment again: it keeps what it read once, in this process."""
    from ray._raylet import AuthenticationTokenLoader, Config  # pyright: ignore

    Config.initialize("")  # first: the loader looks up whether there is to be a token
    AuthenticationTokenLoader.instance().reset_cache()

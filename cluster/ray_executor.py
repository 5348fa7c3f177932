"""Attempts as Ray core tasks, on this machine or on a cluster. The only file that knows Ray.

Ray repeats nothing (`max_retries=0`): the driver owns attempts, and a hidden repetition would
falsify the account of the cost. A hung native call ignores a soft cancellation and leaks its CPU
slot, so attempts are only ever ended by force.
"""

from __future__ import annotations

import logging
import os
import platform
import signal
import socket
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from cluster.guard import Meter, guarded, obituary, read_note, resident_bytes
from cluster.task import AttemptReport, Product, Task
from schemas.errors import InputError

_ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    # Makes a local cluster listen on the loopback address alone; Ray reads it when imported.
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "OMP_NUM_THREADS": "1",  # a slot is one core
    "PYTHONPATH": str(Path(__file__).resolve().parent.parent),
}
_SLOTS_SEEN_FOR_S = 5.0

T = TypeVar("T", bound=Task)


@dataclass(frozen=True)
class RaySettings:
    """Where and how wide to run."""

    address: str = "local"  # or `auto`, `HOST:PORT`, `ray://...` of a running cluster
    workers: int | None = None  # slots of a local cluster; None is one a core
    memory_bytes: int = 0  # reserved per attempt, doubled after a shard ran out of memory; 0: none
    attempts_per_worker: int = 500  # then a fresh process, against slow leaks
    resident_limit_bytes: int = 3 * 2**30  # above it after an attempt: a fresh process at once
    object_store_bytes: int = 80 * 2**20  # only reports travel, so the least that Ray accepts


class RayExecutor(Generic[T]):
    """An executor over a Ray cluster that lives as long as `ray_cluster` is open."""

    def __init__(self, function: Callable[[T, Meter], Product], settings: RaySettings, ray: Any) -> None:
        self._ray, self._settings = ray, settings
        limit_bytes, attempts = settings.resident_limit_bytes, settings.attempts_per_worker

        def work(task: T) -> AttemptReport:
            report = guarded(function, task)
            if resident_bytes() > limit_bytes:
                retire_worker()
            return report

        options: dict[str, Any] = {"num_cpus": 1, "max_retries": 0, "max_calls": attempts}
        self._work = ray.remote(**options)(work)
        self._tasks: dict[Any, T] = {}  # by the reference to the result
        self._refs: dict[str, Any] = {}  # by attempt
        self._killed: set[str] = set()
        self._slots, self._slots_until_s = 1, 0.0

    @property
    def slots(self) -> int:
        if time.monotonic() >= self._slots_until_s:  # a cluster grows and shrinks
            self._slots = max(1, int(self._ray.cluster_resources().get("CPU", 1)))
            self._slots_until_s = time.monotonic() + _SLOTS_SEEN_FOR_S
        return self._slots

    def submit(self, task: T) -> None:
        ref = self._work.options(name=f"shard {task.shard}", **self._memory(task.memory_factor)).remote(task)
        self._tasks[ref], self._refs[task.attempt] = task, ref

    def wait(self, timeout_s: float) -> list[AttemptReport]:
        if not self._tasks:
            time.sleep(timeout_s)
            return []
        refs = list(self._tasks)
        ready, _ = self._ray.wait(refs, num_returns=1, timeout=timeout_s)
        if ready:  # take along whatever else has ended
            ready, _ = self._ray.wait(refs, num_returns=len(refs), timeout=0)
        return [self._report(ref) for ref in ready]

    def has_begun(self, attempt: str) -> bool:
        ref = self._refs.get(attempt)
        return ref is not None and read_note(self._tasks[ref].notes, attempt) is not None

    def kill(self, attempt: str) -> None:
        ref = self._refs.get(attempt)
        if ref is None:
            return
        self._killed.add(attempt)
        self._ray.cancel(ref, force=True)
        # A stopped process does not heed Ray; its note exists only while it is at this attempt.
        note = read_note(self._tasks[ref].notes, attempt)
        if note is not None and note.host == platform.node():
            kill_worker(note.pid)

    def _memory(self, factor: float) -> dict[str, int]:
        if not self._settings.memory_bytes:
            return {}
        # A demand that no machine can meet would wait for ever.
        largest = max((n["Resources"].get("memory", 0) for n in self._ray.nodes() if n["Alive"]), default=0)
        return {"memory": int(min(self._settings.memory_bytes * factor, largest))}

    def _report(self, ref: Any) -> AttemptReport:
        task, e = self._tasks.pop(ref), self._ray.exceptions
        del self._refs[task.attempt]
        killed = task.attempt in self._killed
        self._killed.discard(task.attempt)
        try:
            return self._ray.get(ref)
        except e.RayTaskError as error:  # outside the guard: the task or its module did not arrive whole
            return obituary(task, "failed", f"{type(error.cause).__name__}: {error.cause}")
        except e.TaskCancelledError:
            return obituary(task, "cancelled", "ended by force")
        except e.OutOfMemoryError as error:
            return obituary(task, "out_of_memory", _first_line(error))
        except e.WorkerCrashedError:
            if killed:
                return obituary(task, "cancelled", "ended by force")
            return obituary(task, "crashed", "the worker process died (killed, or ended by native code)")
        except e.RayError as error:  # node, raylet, owner or object gone: the shard is not to blame
            return obituary(task, "lost", f"{type(error).__name__}: {_first_line(error)}")


def refuse_unreachable(address: str) -> None:
    """Raise InputError where nothing listens at a `[ray://]HOST:PORT`; `local` and `auto` pass.

    Ray itself tries for minutes, and with messages of its own.
    """
    if address in ("local", "auto"):
        return
    host, _, port = address.removeprefix("ray://").rpartition(":")
    mend = "Start Ray there and give HOST:PORT, or use --address local"
    if not host or not (port.isascii() and port.isdigit() and len(port) < 6):
        raise InputError("--address", address, "not the address of a cluster", mend)
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=10).close()
    # A name that cannot be encoded is a ValueError, a port above 65535 an OverflowError.
    except (OSError, ValueError, OverflowError) as error:
        raise InputError("--address", address, f"cannot be reached ({error})", mend) from None


@contextmanager
def ray_cluster(settings: RaySettings) -> Generator[Any]:
    """Start a local cluster, or connect to a running one, for the time of the block; gives `ray`.

    A local cluster opens no dashboard and listens on the loopback address alone. Raises InputError
    when the cluster cannot be reached.
    """
    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
    paths = filter(None, (_ENVIRONMENT["PYTHONPATH"], before["PYTHONPATH"]))
    local = settings.address == "local"
    os.environ.update(_ENVIRONMENT | {"PYTHONPATH": os.pathsep.join(paths)})
    try:
        import ray

        options: dict[str, Any] = {}
        if local:
            options = {
                "num_cpus": settings.workers,
                "include_dashboard": False,
                "object_store_memory": settings.object_store_bytes,
            }
        ray.init(address=settings.address, log_to_driver=False, logging_level=logging.ERROR, **options)
    except (ConnectionError, ValueError, TimeoutError) as error:
        raise InputError(
            "--address", settings.address, _first_line(error), "Start Ray there, or use --address local"
        ) from error
    finally:
        # Workers have inherited it; the caller's own environment stays as it was.
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
    # Ray prints a paragraph on standard output for each dead worker; the driver reports it already.
    ray._private.worker._worker_logs_enabled = False  # pyright: ignore
    try:
        yield ray
    finally:
        ray.shutdown()


def retire_worker() -> None:
    """Let this Ray worker process end once its present task has been answered.

    Ray ends a worker when its count of executions reaches `max_calls`; there is no public way to
    ask for it, so the count is put to the last before the end.
    """
    import ray

    manager = ray._private.worker.global_worker.function_actor_manager  # pyright: ignore
    for function_id, info in manager._function_execution_info.items():  # pyright: ignore
        if info.max_calls:
            manager._num_task_executions[function_id] = info.max_calls - 1  # pyright: ignore


def kill_worker(pid: int) -> None:
    """SIGKILL to a process of this machine if it is a Ray worker; others are left alone."""
    try:
        if Path(f"/proc/{pid}/cmdline").read_bytes().startswith(b"ray::"):
            os.kill(pid, signal.SIGKILL)
    except (FileNotFoundError, ProcessLookupError):
        return  # it has ended meanwhile


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__

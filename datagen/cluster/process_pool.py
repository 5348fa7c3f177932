"""Process a list in single-threaded processes on this machine, until it is done or a stop is requested.

For work that is not a shard of a run: the work itself stores its results, piece by piece.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import TYPE_CHECKING, Any, TypeVar

from datagen.cluster.environment import changed_environment
from datagen.schemas.errors import InputError

if TYPE_CHECKING:
    from multiprocessing.synchronize import Event

Item = TypeVar("Item")
Stopping = Callable[[], bool]
Step = Callable[[], None]
# The function of the processes, importable by name: (item, stopping, step) -> whether it was finished. It
# calls `stopping` often, and `step` for each piece.
Work = Callable[[Item, Stopping, Step], bool]

_POLL_S = 0.2
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def work_through(
    verb: str,
    work: Work[Item],
    items: Sequence[Item],
    workers: int,
    stopping: Stopping,
    seen: Callable[[int], None],
) -> bool:
    """Do all items in `workers` processes (0: in this one); return whether all were finished, not stopped.

    `seen` is called with the number of steps so far. Errors of the work are raised. InputError that names
    `verb` where a process ended without a message.
    """
    if not workers:
        return _work_here(work, items, stopping, seen)
    context = multiprocessing.get_context("spawn")
    stop, count = context.Event(), context.Value("q", 0)
    ended: list[bool] = []
    # Libraries read the number of threads when they are loaded.
    with (
        changed_environment(dict.fromkeys(_THREADS, "1")),
        ProcessPoolExecutor(min(workers, len(items)) or 1, context, _begin, (stop, count)) as pool,
    ):
        pending: set[Future[bool]] = {pool.submit(_do, work, item) for item in items}
        try:
            while pending and not stopping():
                done, pending = wait(pending, timeout=_POLL_S, return_when=FIRST_COMPLETED)
                ended += [future.result() for future in done]
                seen(count.value)
        except BrokenProcessPool:
            fix = "Run the same command to resume, with fewer --workers if memory was short"
            raise InputError(verb, "--workers", "a process ended without a message", fix) from None
        finally:
            stop.set()
            for future in pending:
                future.cancel()
    return len(ended) == len(items) and all(ended)


def _work_here(
    work: Work[Item], items: Sequence[Item], stopping: Stopping, seen: Callable[[int], None]
) -> bool:
    steps = 0

    def step() -> None:
        nonlocal steps
        steps += 1
        seen(steps)

    return all(not stopping() and work(item, stopping, step) for item in items)


_stop: Event | None = None
_count: Any = None


def _begin(stop: Event, count: Any) -> None:
    """Set up a process. Ctrl-C reaches the whole group, and only the first process handles it."""
    global _stop, _count
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    _stop, _count = stop, count


def _stopping() -> bool:
    parent = multiprocessing.parent_process()
    return (_stop is not None and _stop.is_set()) or (parent is not None and not parent.is_alive())


def _step() -> None:
    with _count.get_lock():
        _count.value += 1


def _do(work: Work[Item], item: Item) -> bool:
    return not _stopping() and work(item, _stopping, _step)

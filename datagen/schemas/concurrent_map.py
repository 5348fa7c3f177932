"""Concurrent map with bounded look-ahead and ordered results."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import TypeVar

Result = TypeVar("Result")
Item = TypeVar("Item")


def concurrent_map(
    pool: ThreadPoolExecutor, most: int, do: Callable[[Item], Result], items: Iterable[Item]
) -> Generator[Result]:
    """Yield `do(item)` for each item in order, with a bounded number of results computed ahead.

    The first exception ends it; no call is running after the iterator has ended. `items` is consumed in the
    caller's thread, as needed. `do` must not wait for the pool that it runs in.
    """
    begun: deque[Future[Result]] = deque()
    try:
        for item in items:
            begun.append(pool.submit(do, item))
            if len(begun) >= most:
                result = begun[0].result()
                begun.popleft()
                yield result
        while begun:
            result = begun[0].result()
            begun.popleft()
            yield result
    finally:
        for future in begun:
            future.cancel()
        wait(begun)

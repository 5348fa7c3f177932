"""Several things under way at once, their results taken in order."""

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
    """What `do` gives for each item, in their order, with at most so many begun that are not yet taken.

    The first failure ends it. However it ends, nothing of it is under way afterwards: what is undone then
    stays undone. `items` are taken by the caller's thread, as they are needed. `do` must not wait for the
    pool that it runs in.
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

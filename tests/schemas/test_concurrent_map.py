"""Several things at once: in order, so many at a time, and over when they are over."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.schemas.storage import concurrent_map


@given(st.integers(0, 30), st.integers(1, 5), st.integers(1, 9))
def test_results_come_in_order_and_items_are_taken_as_they_are_needed(
    n: int, threads: int, most: int
) -> None:
    taken, given_back = 0, 0

    def items() -> Iterator[int]:
        nonlocal taken
        for i in range(n):
            taken += 1
            assert taken - given_back <= most
            yield i

    with ThreadPoolExecutor(threads) as pool:
        for result in concurrent_map(pool, most, lambda i: i * i, items()):
            assert result == given_back**2
            given_back += 1
    assert (taken, given_back) == (n, n)


class _Pool(ThreadPoolExecutor):
    """One that knows what was asked of it."""

    def __init__(self, threads: int) -> None:
        super().__init__(threads)
        self.asked: list[Future[Any]] = []

    def submit(self, *arguments: Any, **named: Any) -> Future[Any]:
        self.asked.append(super().submit(*arguments, **named))
        return self.asked[-1]

    def let_go_when_cancelled(self, event: threading.Event) -> None:
        """Set the event once the last that was asked is cancelled: then all that waited are."""
        while len(self.asked) < 4 or not self.asked[-1].cancelled():
            time.sleep(0.001)
        event.set()


@pytest.mark.parametrize("by", ["failure", "leaving"])
def test_nothing_is_under_way_when_it_has_ended(by: str) -> None:
    begun, ended = set[int](), set[int]()
    second, let_end = threading.Event(), threading.Event()

    def do(i: int) -> int:
        begun.add(i)
        if i == 0:
            second.wait()
            if by == "failure":
                raise ValueError("the first")
        else:
            second.set()
            assert let_end.wait(600)
        ended.add(i)
        return i

    with _Pool(2) as pool:
        results = concurrent_map(pool, 4, do, range(9))
        threading.Thread(target=lambda: pool.let_go_when_cancelled(let_end), daemon=True).start()
        if by == "failure":
            with pytest.raises(ValueError, match="the first"):
                next(results)
            assert begun - ended == {0}
        else:
            assert next(results) == 0
            results.close()
            assert begun == ended
        before = set(begun)
        assert list(results) == [] and 1 in before
    assert begun == before <= {0, 1, 2}

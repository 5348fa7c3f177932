"""Several things at once: in order, so many at a time, and over when they are over."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

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


@pytest.mark.parametrize("by", ["failure", "leaving"])
def test_nothing_is_under_way_when_it_has_ended(by: str) -> None:
    begun, ended, second = set[int](), set[int](), threading.Event()

    def do(i: int) -> None:
        begun.add(i)
        if i == 0:
            second.wait()
            ended.add(i)
            if by == "failure":
                raise ValueError
            return
        second.set()
        time.sleep(0.05)  # seconds in which the end could be too early
        ended.add(i)

    with ThreadPoolExecutor(2) as pool:
        results = concurrent_map(pool, 4, do, range(9))
        with suppress(ValueError):
            next(results)
        results.close()
        before = set(begun)
        assert begun == ended and list(results) == []
    assert begun == before and 1 in before and max(before) < 8

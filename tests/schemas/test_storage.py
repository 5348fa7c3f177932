"""Storage: one winner, nothing half-written, errors of one line, concurrent calls in order."""

from __future__ import annotations

import os
import pickle
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.schemas.errors import InputError
from datagen.schemas.storage import Storage, concurrent_map, open_storage
from tests.made_runs import files_of


@pytest.fixture(params=["disk", "s3"])
def place(request: pytest.FixtureRequest, tmp_path: Path, bucket: str) -> str:
    return f"{tmp_path}/runs/a" if request.param == "disk" else f"{bucket}/runs/a"


def test_files_are_stored_listed_and_removed_on_disk_and_on_s3(place: str):
    s = open_storage(f"{place}/")
    assert (s.url, s.folder) == (place, None if place.startswith("s3") else Path(place))
    s.put("a/b", b"12")
    s.put("a/b", b"123")
    s.put("ab/c", b"", durably=False)
    assert s.get("a/b", 10) == b"123" and s.get("a/none", 10) is None
    assert [(f.key, f.size) for f in s.list("a")] == [("a/b", 3)]
    assert sorted(f.key for f in s.list("")) == ["a/b", "ab/c"] and list(s.list("none")) == []
    assert s.put_new("x/y", b"123") and s.put_new("x/y", b"123") and not s.put_new("x/y", b"12")
    again: Storage = pickle.loads(pickle.dumps(s))
    assert again.get("x/y", 9) == s.below("x").get("y", 9) == b"123"
    with pytest.raises(InputError, match="3 bytes, more than the 2"):
        s.get("x/y", 2)
    s.delete(["a/b", "a/none"])
    assert (s.exists("a/b"), s.exists("x/y")) == (False, True)
    assert open_storage(place.removesuffix("/runs/a")).get("runs/a/x/y", 9) == b"123"


def test_ranges_are_cut_at_the_end_of_a_file(place: str):
    s, data = open_storage(place), bytes(range(100))
    s.put("a/b", data)
    inside, beyond = ((0, 3), (40, 60), (99, 1), (-4, 4), (-100, 100)), ((90, 50), (100, 5), (10**6, 2**30))
    for start, size in (*inside, *beyond, (-999, 999)):
        assert s.get_range("a/b", start, size) == data[start:][:size], (start, size)
    assert s.get_range("a/none", 0, 1) is s.get_range("none", -1, 1) is None


def test_places_that_cannot_hold_a_run(tmp_path: Path):
    (tmp_path / "file").write_text("x")
    for place, problem in [
        ("", "not the name of a folder"),
        ("a\0b", "not the name of a folder"),
        (tmp_path / "file", "is a file"),
        (tmp_path / "file" / "below", "A file is where a folder is needed"),
        (tmp_path / ("x" * 300), "shorter path"),
        ("gopher://there/run", "Name a folder or an s3://"),
    ]:
        with pytest.raises(InputError, match=problem):
            open_storage(place)
    open_storage(tmp_path / "new")
    assert files_of(tmp_path / "new") == {}  # of its probe
    with pytest.raises(InputError, match="no such folder"):
        open_storage(tmp_path / "none", create=False)
    assert not (tmp_path / "none").exists()


def test_without_permission_every_verb_is_refused_in_one_line():
    user = os.geteuid()
    with TemporaryDirectory() as name:  # others can reach it, unlike folders of pytest
        s = open_storage(name, probe=False)
        Path(name).chmod(0)
        os.seteuid(user or 65534)
        try:
            for verb in (
                lambda: open_storage(name),
                lambda: s.put("a", b""),
                lambda: s.put_new("a", b""),
                lambda: s.get("a", 9),
                lambda: s.exists("a"),
                lambda: list(s.list("")),
            ):
                with pytest.raises(InputError, match="Permission denied"):
                    verb()
        finally:
            os.seteuid(user)
            Path(name).chmod(0o700)


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

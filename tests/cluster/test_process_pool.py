"""Work in processes: all of it, until a stop, and errors."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from datagen.cluster.process_pool import work_through
from datagen.schemas.errors import InputError


def write(item: tuple[str, int], stopping: Callable[[], bool], step: Callable[[], None]) -> bool:
    """Write `n` files, one a step, over and over the same hundred."""
    folder, n = item
    for k in range(n):
        if stopping():
            return False
        Path(folder, f"{k % 100}-{os.getpid()}-{os.environ.get('OMP_NUM_THREADS')}").touch()
        step()
    return True


def refuse(item: str, stopping: Callable[[], bool], step: Callable[[], None]) -> bool:
    raise InputError(item, "", "is bad", "Give another")


def die(item: str, stopping: Callable[[], bool], step: Callable[[], None]) -> bool:
    os._exit(3)


@pytest.mark.parametrize("workers", [0, 2])
def test_all_is_done_and_counted(tmp_path: Path, workers: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    items, seen = [(str(tmp_path / name), 3) for name in "abcd"], list[int]()
    for folder, _ in items:
        Path(folder).mkdir()
    assert work_through("verb", write, items, workers, lambda: False, seen.append)
    assert all(len(list(Path(folder).iterdir())) == 3 for folder, _ in items)
    assert seen[-1] == 12 and seen == sorted(seen)
    threads = {path.name.split("-")[2] for folder, _ in items for path in Path(folder).iterdir()}
    assert threads == {"1" if workers else "5"} and os.environ["OMP_NUM_THREADS"] == "5"


@pytest.mark.parametrize("workers", [0, 1])
def test_a_stop_ends_it(tmp_path: Path, workers: int) -> None:
    seen: list[int] = []
    endless = [(str(tmp_path), 10**9)]
    assert not work_through("verb", write, endless, workers, lambda: bool(seen and seen[-1]), seen.append)
    assert any(tmp_path.iterdir())


@pytest.mark.parametrize("workers", [0, 1])
def test_errors_are_raised(workers: int) -> None:
    with pytest.raises(InputError, match="is bad"):
        work_through("verb", refuse, ["item"], workers, lambda: False, lambda _: None)


def test_a_process_that_dies_is_named() -> None:
    with pytest.raises(InputError, match="verb: --workers: a process ended without a message"):
        work_through("verb", die, ["item"], 1, lambda: False, lambda _: None)

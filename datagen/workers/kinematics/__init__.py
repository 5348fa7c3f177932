"""How bodies on trees of joints move, reach and touch, in machine code."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager

_listeners = list[Callable[[], object]]()


@contextmanager
def on_compiling(tell: Callable[[], object]) -> Generator[None]:
    """Call `tell` once where a function is compiled in the block, before it is."""
    _listeners.append(tell)
    try:
        yield
    finally:
        if tell in _listeners:  # nothing was compiled
            _listeners.remove(tell)


def tell_of_compiling() -> None:
    """Call what waits for the first compilation."""
    while _listeners:
        _listeners.pop()()

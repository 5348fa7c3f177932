"""Standard error, where progress goes: text that cannot be written is dropped, and the work goes on."""

from __future__ import annotations

import select
from contextlib import suppress
from typing import Any, TextIO


class LossyStream:
    """A text stream that drops text for a closed pipe, a full disk or a lost terminal.

    With `waits` false it also drops text for a reader that does not keep up, where a write would block.
    """

    def __init__(self, stream: TextIO, waits: bool = True) -> None:
        self._stream, self._poll = stream, None if waits else _poll_of(stream)

    def write(self, text: str) -> int:
        with suppress(OSError, ValueError):  # ValueError: the stream is closed
            if self._poll is None or self._poll.poll(0):
                self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with suppress(OSError, ValueError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _poll_of(stream: TextIO) -> select.poll | None:
    """Whether the stream can be written now; None for one without a descriptor, as of a notebook."""
    try:
        number = stream.fileno()
    except (OSError, ValueError, AttributeError):
        return None
    poll = select.poll()
    poll.register(number, select.POLLOUT)
    return poll

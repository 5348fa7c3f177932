"""Which files of a folder are opened: by whatever name and library, as the kernel tells it."""

from __future__ import annotations

import ctypes
import os
import struct
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

# Constants of linux/inotify.h: a file was read, a file or a folder was opened, events were lost.
_IN_ACCESS, _IN_OPEN, _IN_Q_OVERFLOW = 0x1, 0x20, 0x4000
_HEADER = struct.Struct("iIII")  # watch, mask, cookie, bytes of the name after it


@contextmanager
def watched(folder: Path) -> Generator[list[str]]:
    """Names of what in the folder was opened or read inside the block; `.` is the folder itself.

    The list is filled when the block ends. Files in folders below are not seen, and neither is a file
    of which only the metadata was asked for.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    events = libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
    if events < 0:
        raise OSError(ctypes.get_errno(), "inotify_init1")
    try:
        if libc.inotify_add_watch(events, os.fsencode(folder), _IN_ACCESS | _IN_OPEN) < 0:
            raise OSError(ctypes.get_errno(), "inotify_add_watch", str(folder))
        opened: list[str] = []
        yield opened
        opened.extend(dict.fromkeys(_names(events)))
    finally:
        os.close(events)


def _names(events: int) -> Generator[str]:
    while True:
        try:
            data = os.read(events, 1 << 16)
        except BlockingIOError:
            return
        start = 0
        while start < len(data):
            _, mask, _, length = _HEADER.unpack_from(data, start)
            start += _HEADER.size + length
            if mask & _IN_Q_OVERFLOW:
                yield "events that were lost"
            yield os.fsdecode(data[start - length : start].rstrip(b"\0")) or "."

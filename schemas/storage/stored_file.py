"""An entry of a listing."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class StoredFile:
    """One listed file: its key below the storage's root, its size in bytes, and its change stamp.

    Equal stamps of one key mean equal bytes: the store's entity tag, or inode, time of change and size of a
    file. `modified_s` is the time of the last write, in seconds since 1970 UTC.
    """

    key: str
    size: int
    stamp: str = ""
    modified_s: float = 0.0

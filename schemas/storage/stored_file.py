"""What a listing tells of a file."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class StoredFile:
    """One listed file: its key below the storage's root, its size in bytes, and its change stamp.

    Equal stamps of one key mean equal bytes: the store's entity tag, or what the file system notes of
    the file (inode, time of change and size). `modified_s` is when it was last written, in seconds since
    1970 UTC.
    """

    key: str
    size: int
    stamp: str = ""
    modified_s: float = 0.0

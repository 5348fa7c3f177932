"""Untrusted zip archives and numpy headers: the exceptions of damaged or malicious ones."""

from __future__ import annotations

import tokenize
import zipfile
import zlib
from typing import IO

# Exceptions of zipfile for the directory, and for a member of `open_member`.
DAMAGED_ZIP = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,  # a truncated member
    RuntimeError,  # an encrypted member; its subclass NotImplementedError: an unknown version or method
    # An offset before the start of the file, or a bad member; UnicodeDecodeError for a name not in UTF-8.
    ValueError,
)
# Exceptions of numpy.lib.format for an array's header, which it parses as Python, and for its bytes.
DAMAGED_ARRAY = (
    ValueError,
    SyntaxError,
    tokenize.TokenError,  # an unclosed bracket or string
    TypeError,  # keys of mixed types, or unhashable ones
    LookupError,  # an empty description of a type
    OverflowError,  # an axis longer than the index type
    EOFError,
    MemoryError,  # deeply nested brackets, or more items than memory
    RecursionError,
)
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def open_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> IO[bytes]:
    """Open a stored or deflated member. Raises one of `DAMAGED_ZIP`; ValueError for other methods.

    Damaged bzip2 raises OSError as a failing disk does, and an LZMA header can claim up to 4 GiB of memory.
    """
    if member.compress_type not in _METHODS:
        method = member.compress_type
        raise ValueError(f"{member.filename!r} has compression method {method}, neither stored nor deflated")
    return archive.open(member)

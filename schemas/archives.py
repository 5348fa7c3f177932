"""Archives of unknown origin: what reading one raises that is damaged, or was made to do harm."""

from __future__ import annotations

import tokenize
import zipfile
import zlib
from typing import IO

# What zipfile raises over its directory or over a member of `open_member`.
DAMAGED_ZIP = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,  # a member that is cut
    RuntimeError,  # an encrypted member; a version or flag that zipfile does not know raises a kind of it
    # An offset before the file begins, a member that is not read; with UnicodeDecodeError, a name no UTF-8.
    ValueError,
)
# What numpy.lib.format raises over an array's header, which it reads as Python, and over its bytes.
DAMAGED_ARRAY = (
    ValueError,
    SyntaxError,
    tokenize.TokenError,  # a bracket or a text without its end
    TypeError,  # keys of several kinds, an unhashable one
    LookupError,  # a type described by nothing
    OverflowError,  # an axis longer than an index
    EOFError,
    MemoryError,  # brackets in brackets, or more items than there is memory for
    RecursionError,
)
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def open_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> IO[bytes]:
    """A stored or deflated member, for reading. Raises one of `DAMAGED_ZIP`, ValueError for other methods:

    damaged bzip2 raises OSError, as a failing disk does; LZMA takes up to 4 GiB at a header's word.
    """
    if member.compress_type not in _METHODS:
        method = member.compress_type
        raise ValueError(f"{member.filename!r} is compressed by method {method}, neither stored nor deflated")
    return archive.open(member)

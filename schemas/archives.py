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
    RuntimeError,  # an encrypted member; with NotImplementedError, which is one, unknown methods and versions
    ValueError,  # an offset before the file begins; with UnicodeDecodeError, a name that is no UTF-8
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
    """A stored or deflated member, for reading. NotImplementedError for other methods, else `DAMAGED_ZIP`.

    Damaged bzip2 raises OSError, as a failing disk does; LZMA takes up to 4 GiB at a header's word.
    """
    if member.compress_type not in _METHODS:
        raise NotImplementedError(f"compression method {member.compress_type}")
    return archive.open(member)

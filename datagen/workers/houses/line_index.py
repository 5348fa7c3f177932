"""Random access to the lines of large JSON-lines files, compressed or not, shared by processes.

A compressed file is unpacked once into the cache folder and mapped into memory, so that all
workers of a machine share its pages. The index (offset, length, sha256 and id of every line) is
stored with it. Both are named by the digest of the source file and appear by an atomic rename; the
index comes last, so that its presence means both are complete. If there are more than 64 files, those
not used for a day are removed, least recently used first.
"""

from __future__ import annotations

import gzip
import hashlib
import itertools
import mmap
import os
import re
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
import numpy.typing as npt

from datagen.schemas.errors import InputError
from datagen.schemas.identity import canonical_json
from datagen.schemas.untrusted_files import open_regular, read_regular
from datagen.schemas.whole_files import whole_file
from datagen.workers.content_cache import cache_folder, drop_unused, read_arrays, refresh, write_arrays
from datagen.workers.json_document import parse_json

MAX_LINE_BYTES = 16 << 20  # the largest known house has 0.1 MB
MAX_LINES = 500_000  # fifty times the known sets; each needs half a kilobyte of memory
_MAX_FILE_BYTES = 64 << 30
# Houses compress to a twentieth of their size; a file that unpacks to far more is a decompression bomb.
_MAX_UNPACKED_BYTES, _MAX_RATIO = 256 << 20, 100
_MAX_IN_MEMORY_BYTES = 2 << 30
_FORMAT = 2  # raise it when the layout of the cached files changes
_ID_KEY = re.compile(rb'"_id"\s*:\s*"([^"\\]{1,200})"')
_FIX = "Restore the file from its source."
_MAX_INDEX_BYTES = 512 * MAX_LINES
_MOST_CACHED = 64  # files: unpacked houses and their indexes
_IDLE_S = 86_400.0
_LAYOUT = {
    "spans": (np.int64, ("lines", 2)),
    "digests": (np.uint8, ("lines", 32)),
    "ids": (np.uint8, ("bytes",)),
    "numbers": (np.int64, ("lines",)),
    "size": (np.int64, ()),
}


@dataclass(frozen=True, eq=False)
class LineIndex:
    """Lines of one file: `data` holds the bytes, the arrays locate the lines in them."""

    path: Path
    data: mmap.mmap | bytearray
    spans: npt.NDArray[np.int64]  # (N, 2): offset, length
    digests: npt.NDArray[np.uint8]  # (N, 32): sha256 of each line
    ids: list[str]  # "" where a line names no id of its own
    line_numbers: npt.NDArray[np.int64]  # (N,), from 1

    def line(self, row: int) -> bytes:
        """The bytes of a line, checked against the index; read from the source file if the copy is damaged.

        Raises InputError if the source file has lost the line too.
        """
        offset, length = (int(v) for v in self.spans[row])
        text = bytes(self.data[offset : offset + length])
        if self._is_row(row, text):
            return text
        # The unpacked copy was damaged. Skipping the house would silently change the scenes.
        number = int(self.line_numbers[row])
        text = next((line for n, line in _lines(self.path) if n == number), b"")
        if self._is_row(row, text):
            return text
        place = f"{self.path}:{number}"
        raise InputError(place, "", "has changed since it was opened", "Run the command again.")

    def _is_row(self, row: int, text: bytes) -> bool:
        return hashlib.sha256(text).digest() == self.digests[row].tobytes()


def open_lines(path: Path, cache: Path | None) -> LineIndex:
    """The index of a .jsonl, .jsonl.gz or .json file; `cache` None keeps everything in memory."""
    try:
        digest = _file_digest(path)
        cached = cache and (_from_cache(path, cache, digest) or _build_in_cache(path, cache, digest))
        return cached or _build_in_memory(path)
    except OSError as error:
        if isinstance(error, gzip.BadGzipFile):
            raise InputError(path, "", f"is not a gzip file ({error})", _FIX) from None
        raise InputError(path, "", f"cannot be read ({error.strerror})", "Make it readable.") from None
    except EOFError:
        raise InputError(path, "", "is a truncated gzip file", _FIX) from None
    except zlib.error as error:
        raise InputError(path, "", f"has damaged compressed data ({error})", _FIX) from None


def houses_cache() -> Path | None:
    """The cache's folder of unpacked houses; None if it cannot be written."""
    folder = cache_folder() / "houses"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return folder if os.access(folder, os.W_OK) else None


def _lines(path: Path) -> Iterator[tuple[int, bytes]]:
    """(line number, line without its end) of every non-empty line, one at a time."""
    if path.suffix == ".json":
        yield from _documents(path)
        return
    with open_regular(path, _MAX_FILE_BYTES, _FIX) as file:
        left, stream = _MAX_FILE_BYTES, cast(IO[bytes], file)
        if path.suffix == ".gz":
            left = _MAX_UNPACKED_BYTES + _MAX_RATIO * os.fstat(file.fileno()).st_size
            stream = cast(IO[bytes], gzip.GzipFile(fileobj=file, mode="rb"))
        for number in itertools.count(1):
            line = stream.readline(MAX_LINE_BYTES + 1)
            if not line:
                return
            left -= len(line)
            if len(line) > MAX_LINE_BYTES or number > MAX_LINES or left < 0:
                problem = f"a line of more than {MAX_LINE_BYTES >> 20} MiB"
                if len(line) <= MAX_LINE_BYTES:
                    problem = f"more than {MAX_LINES:,} lines" if left >= 0 else "unpacks to too many bytes"
                raise InputError(f"{path}:{number}", "", problem, _FIX)
            if line := line.strip():
                yield number, line


def _documents(path: Path) -> Iterator[tuple[int, bytes]]:
    """(number, text) of every house of a .json file, which holds one house or a list of them."""
    text = read_regular(path, MAX_LINE_BYTES * 4, "Store one house per line (.jsonl).").strip()
    if not text.startswith(b"["):
        yield 1, text
        return
    root = parse_json(text, str(path))
    for number, node in enumerate(root.items(MAX_LINES), 1):
        try:
            yield number, canonical_json(node.value).encode()
        except (ValueError, RecursionError):
            raise node.error("has NaN or infinity in a list of houses", "Store one house per line.") from None


def _file_digest(path: Path) -> str:
    with open_regular(path, _MAX_FILE_BYTES, _FIX) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _own_id(line: bytes) -> str:
    """The house's own name: its top-level `_id`; "" if there is none or it is not printable."""
    names = _ID_KEY.findall(line)
    if len(names) > 1:
        try:
            value: Any = parse_json(line, "").value
        except InputError:
            return ""  # the line is reported when it is loaded
        own = cast(dict[str, Any], value).get("_id") if isinstance(value, dict) else None
        name = own if isinstance(own, str) and len(own) <= 200 else ""
    else:
        name = names[0].decode("utf-8", "replace") if names else ""
    return name if name.isprintable() and "\N{REPLACEMENT CHARACTER}" not in name else ""


def _copy(path: Path, write: Callable[[bytes], object]) -> dict[str, npt.NDArray[Any]]:
    """Writes the lines of a file one after another; returns their index."""
    spans: list[tuple[int, int]] = []
    digests: list[bytes] = []
    ids: list[str] = []
    numbers: list[int] = []
    offset = 0
    for number, line in _lines(path):
        write(line + b"\n")
        spans.append((offset, len(line)))
        digests.append(hashlib.sha256(line).digest())
        ids.append(_own_id(line))
        numbers.append(number)
        offset += len(line) + 1
    return {
        "spans": np.array(spans, np.int64).reshape(-1, 2),
        "digests": np.frombuffer(b"".join(digests), np.uint8).reshape(-1, 32),
        "ids": np.frombuffer("\n".join(ids).encode(), np.uint8),
        "numbers": np.array(numbers, np.int64),
        "size": np.array(offset, np.int64),
    }


def _index(path: Path, data: mmap.mmap | bytearray, arrays: dict[str, npt.NDArray[Any]]) -> LineIndex:
    count = len(arrays["spans"])
    ids = arrays["ids"].tobytes().decode().split("\n") if count else []
    return LineIndex(path, data, arrays["spans"], arrays["digests"], ids, arrays["numbers"])


def _names(cache: Path, digest: str) -> tuple[Path, Path]:
    return cache / f"{digest}-v{_FORMAT}.jsonl", cache / f"{digest}-v{_FORMAT}.npz"


def _from_cache(path: Path, cache: Path, digest: str) -> LineIndex | None:
    """The index from the cache; None if a file is missing or the two do not match."""
    data_path, index_path = _names(cache, digest)
    arrays = read_arrays(index_path, _LAYOUT, _MAX_INDEX_BYTES)
    if arrays is None:
        return None
    try:
        size = int(arrays["size"])
        if data_path.stat().st_size != size:
            return None
        with data_path.open("rb") as stream:
            data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) if size else bytearray()
        refresh(data_path)
        refresh(index_path)
        return _index(path, data, arrays)
    except (OSError, ValueError):
        return None  # absent or damaged: it is rebuilt


def _build_in_cache(path: Path, cache: Path, digest: str) -> LineIndex | None:
    """Unpacks into the cache; None if the cache cannot be written (full, gone, read-only)."""
    data_path, index_path = _names(cache, digest)
    try:
        with whole_file(data_path) as file:
            arrays = _copy(path, file.write)
    except OSError:
        return None  # if the source is at fault, reading it into memory reports that
    if not write_arrays(index_path, arrays):
        return None
    drop_unused(cache, _MOST_CACHED, _IDLE_S)
    return _from_cache(path, cache, digest)


def _build_in_memory(path: Path) -> LineIndex:
    data = bytearray()

    def write(line: bytes) -> None:
        data.extend(line)
        if len(data) > _MAX_IN_MEMORY_BYTES:
            fix = "Set DATAGEN_CACHE to a folder with space for the unpacked houses."
            raise InputError(path, "", "is too large to unpack in memory", fix)

    return _index(path, data, _copy(path, write))

"""Random access to the lines of large JSON-lines files, compressed or not, shared by processes.

The lines of a file are packed once into a zip in the cache folder, one member each: its name is the line's
number, its comment the line's sha256 and id. Without a writable cache the zip is kept in memory.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import itertools
import os
import re
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import DAMAGED_ZIP, open_regular, whole_file
from datagen.workers.content_cache import cache_folder, drop_unused, refresh
from datagen.workers.foreign_files import START_BYTES, refuse_other_kind
from datagen.workers.json_document import parse_json

MAX_LINE_BYTES = 16 << 20  # the largest known house has 0.1 MB
MAX_LINES = 100_000  # eight times the known sets; each needs a kilobyte of memory
_MAX_FILE_BYTES = 64 << 30
# Houses compress to a twentieth of their size; a file that unpacks to far more is a decompression bomb.
_MAX_UNPACKED_BYTES, _MAX_RATIO = 256 << 20, 100
_FORMAT = 3  # raise it when the layout of the cached files changes
_MOST_CACHED = 64  # files of packed houses
_ID_KEY = re.compile(rb'"_id"\s*:\s*"([^"\\]{1,200})"')
_FIX = "Restore the file from its source."


@dataclass(frozen=True)
class Line:
    """One line: its number from 1, the sha256 of its bytes, and its own id, "" if it names none."""

    number: int
    sha256: str
    house_id: str


@dataclass(frozen=True, eq=False)
class LineIndex:
    """The non-empty lines of one file."""

    path: Path
    archive: zipfile.ZipFile
    lines: list[Line]

    def text(self, line: Line) -> bytes:
        """The bytes of a line; read from the source file if the packed copy is damaged.

        Raises InputError if the source file has lost the line too.
        """
        try:
            return self.archive.read(str(line.number))  # checks the CRC
        except (OSError, *DAMAGED_ZIP):
            # Skipping the house would silently change the scenes.
            text = next((text for n, text in _lines(self.path) if n == line.number), b"")
        if hashlib.sha256(text).hexdigest() != line.sha256:
            place = f"{self.path}:{line.number}"
            raise InputError(place, "", "has changed since it was opened", "Run the command again.")
        return text


def open_lines(path: Path) -> LineIndex:
    """The index of a .jsonl or .jsonl.gz file, or of a .json file as one line.

    Raises InputError that names the file or its line.
    """
    expected = "a gzip file" if path.suffix == ".gz" else "text"
    try:
        with open_regular(path, _MAX_FILE_BYTES, _FIX) as stream:
            refuse_other_kind(path, stream.read(START_BYTES), expected, _FIX)
            stream.seek(0)
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
        packed = cache_folder() / "houses" / f"{digest}-v{_FORMAT}{'-whole' * (path.suffix == '.json')}.zip"
        return _opened(path, packed) or _opened(path, _packed(path, packed)) or _in_memory(path)
    except OSError as error:
        if isinstance(error, gzip.BadGzipFile):
            raise InputError(path, "", f"is not a gzip file ({error})", _FIX) from None
        raise InputError(path, "", f"cannot be read ({error.strerror})", "Make it readable.") from None
    except EOFError:
        raise InputError(path, "", "is a truncated gzip file", _FIX) from None
    except zlib.error as error:
        raise InputError(path, "", f"has damaged compressed data ({error})", _FIX) from None


def _opened(path: Path, packed: Path | IO[bytes]) -> LineIndex | None:
    try:
        archive = zipfile.ZipFile(packed)
        lines: list[Line] = []
        for member in archive.infolist():
            digest, _, house_id = member.comment.decode().partition(" ")
            lines.append(Line(int(member.filename), digest, house_id))
    except (OSError, *DAMAGED_ZIP):
        return None
    if isinstance(packed, Path):
        refresh(packed)
    return LineIndex(path, archive, lines)


def _packed(path: Path, packed: Path) -> Path:
    """Packs the lines into the cache if it can be written."""
    try:
        packed.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(packed) as file:
            _pack(path, file)
        drop_unused(packed.parent, _MOST_CACHED)
    except OSError:
        pass  # if the source is at fault, reading it into memory reports that
    return packed


def _in_memory(path: Path) -> LineIndex:
    _pack(path, data := io.BytesIO())
    found = _opened(path, data)
    assert found is not None
    return found


def _pack(path: Path, file: IO[bytes]) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for number, text in _lines(path):
            member = zipfile.ZipInfo(str(number))
            member.compress_type = zipfile.ZIP_DEFLATED
            member.comment = f"{hashlib.sha256(text).hexdigest()} {_own_id(text)}".encode()
            archive.writestr(member, text)


def _lines(path: Path) -> Iterator[tuple[int, bytes]]:
    """(line number, line without its end) of every non-empty line, one at a time."""
    with open_regular(path, _MAX_FILE_BYTES, _FIX) as file:
        left, stream = _MAX_FILE_BYTES, cast(IO[bytes], file)
        if path.suffix == ".gz":
            left = _MAX_UNPACKED_BYTES + _MAX_RATIO * os.fstat(file.fileno()).st_size
            stream = cast(IO[bytes], gzip.GzipFile(fileobj=file, mode="rb"))
        for number in itertools.count(1):
            whole = path.suffix == ".json"
            line = stream.read(MAX_LINE_BYTES + 1) if whole else stream.readline(MAX_LINE_BYTES + 1)
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

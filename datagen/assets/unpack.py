"""Unpack untrusted archives: no file outside the folder, and bounded sizes."""

from __future__ import annotations

import errno
import gzip
import re
import stat
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, Any, cast

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import DAMAGED_ZIP, is_inside, open_member

_CHUNK_BYTES = 2**20
# zipfile reads its list of members at once; tarfile reads a header's extension, which may have its own.
_ZIP_LIST = 16 * 2**20
_NAME = re.compile(r"[^\\:\x00-\x1f]{1,1000}")
_ADVICE = "Do not use this archive; fetch it from its publisher"


@dataclass(frozen=True)
class Limits:
    """The largest result of an archive."""

    total_bytes: int
    files: int = 200_000


_Member = tuple[str, int, IO[bytes]]  # its name, its size as stated, and its content


def unpack(archive: Path, folder: Path, limits: Limits) -> list[PurePosixPath]:
    """Unpack a zip, tar or gzipped tar into `folder`; return the files, relative and sorted.

    Members are unpacked into a temporary folder and moved when the whole archive is good, so a refused
    archive leaves no file; existing files of the same names are replaced. Only plain files and folders are
    allowed: absolute names, `..`, links, devices, repeated names and sizes above `limits` raise InputError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".unpack-", dir=folder) as staging_name:
        staging = Path(staging_name)
        names: dict[str, PurePosixPath] = {}
        total = 0
        try:
            for member in _members(archive, limits):
                relative = _safe_name(archive, member[0])
                # Names that differ only in case are one file on some systems.
                if names.setdefault(str(relative).casefold(), relative) is not relative:
                    raise InputError(archive, str(relative), "is in the archive twice", _ADVICE)
                if len(names) > limits.files:
                    raise InputError(archive, "", f"has more than {limits.files:,} files", _ADVICE)
                total += _copy(archive, member, staging / relative, limits.total_bytes - total)
        except (OSError, tarfile.TarError, RecursionError, *DAMAGED_ZIP) as error:
            # EINVAL: an offset before the archive's start. Other numbers are of the disk.
            of_disk = isinstance(error, OSError) and error.errno not in (None, errno.EINVAL)
            if of_disk or isinstance(error, InputError):
                raise
            fix = "Remove it from the cache and fetch it again"
            raise InputError(archive, "", f"is damaged ({error})", fix) from error
        files = sorted(names.values())
        for relative in files:
            target = folder / relative
            if not is_inside(folder, target.parent):
                problem = f"{target.parent} is behind a link that leads out of the folder"
                raise InputError(archive, str(relative), problem, "Remove it or use an empty folder")
            target.parent.mkdir(parents=True, exist_ok=True)
            (staging / relative).replace(target)
    return files


def _members(archive: Path, limits: Limits) -> Iterator[_Member]:
    if zipfile.is_zipfile(archive):
        yield from _zip_members(archive, limits)
        return
    with archive.open("rb") as raw:
        packed = raw.read(2) == b"\x1f\x8b"
        raw.seek(0)
        plain: Any = gzip.GzipFile(fileobj=raw) if packed else raw
        bounded: Any = _BoundedStream(archive, plain, _CHUNK_BYTES)
        with tarfile.open(fileobj=bounded, mode="r:") as tar:
            for count, info in enumerate(tar):
                if count > 2 * limits.files:
                    raise InputError(archive, "", f"has more than {2 * limits.files:,} entries", _ADVICE)
                if info.isdir():
                    _safe_name(archive, info.name)
                    continue
                if not info.isreg() or info.issparse():
                    raise InputError(archive, info.name, "is a link, device or special file", _ADVICE)
                if info.size > limits.total_bytes:
                    raise InputError(archive, info.name, f"claims {info.size:,} bytes", _ADVICE)
                stream = tar.extractfile(info)
                assert stream is not None
                yield info.name, info.size, stream


def _zip_members(archive: Path, limits: Limits) -> Iterator[_Member]:
    with (
        archive.open("rb") as raw,
        zipfile.ZipFile(cast(IO[bytes], _BoundedStream(archive, raw, _ZIP_LIST))) as packed,
    ):
        claimed = sum(info.file_size for info in packed.infolist())
        if claimed > limits.total_bytes:
            raise InputError(archive, "", f"claims to unpack to {claimed:,} bytes", _ADVICE)
        for info in packed.infolist():
            kind = stat.S_IFMT(info.external_attr >> 16)
            if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
                raise InputError(archive, info.filename, "is a link, device or special file", _ADVICE)
            _safe_name(archive, info.filename)
            if info.is_dir():
                continue
            with open_member(packed, info) as stream:
                yield info.filename, info.file_size, stream


def _safe_name(archive: Path, name: str) -> PurePosixPath:
    path = PurePosixPath(name)
    if not _NAME.fullmatch(name) or path.is_absolute() or ".." in path.parts:
        raise InputError(archive, repr(name[:80]), "is a path outside the folder", _ADVICE)
    return path


def _copy(archive: Path, member: _Member, target: Path, room: int) -> int:
    """Copy at most `room` bytes, whatever size the archive claims; return their number."""
    (name, size, stream), copied = member, 0
    target.parent.mkdir(parents=True, exist_ok=True)
    with target.open("xb") as out:
        while chunk := stream.read(_CHUNK_BYTES):
            copied += len(chunk)
            if copied > room:
                raise InputError(archive, name, "unpacks to more bytes than allowed", _ADVICE)
            out.write(chunk)
    if copied != size:
        raise InputError(archive, name, f"has {copied:,} of {size:,} bytes", _ADVICE)
    return copied


class _BoundedStream:
    """A readable, seekable stream that refuses huge single reads."""

    def __init__(self, archive: Path, stream: Any, largest: int) -> None:
        self._archive = archive
        self._largest = largest
        self._stream = stream

    def read(self, size: int = -1) -> bytes:
        data = b"" if size > self._largest else self._stream.read(size if size >= 0 else self._largest + 1)
        if max(size, len(data)) > self._largest:
            raise InputError(self._archive, "", "has a header that is too large", _ADVICE)
        return data

    def seek(self, offset: int, whence: int = 0) -> int:
        return self._stream.seek(offset, whence)

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._stream.tell()

"""The lock file of an asset folder: digests, licences and origins of its files.

`assets.lock.json` is in the folder itself and lists each file's relative path, sha256, size, licence and
source, and each download's address and digest. A download whose publisher states no digest is trusted on
first use: its digest is recorded here, and later fetches must match it.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

from pydantic import Field, ValidationError

from datagen.schemas.errors import InputError
from datagen.schemas.run_records import Digest, StoredRecord
from datagen.schemas.untrusted_files import open_regular, read_regular
from datagen.schemas.whole_files import whole_file

LOCK_NAME = "assets.lock.json"
_MAX_LOCK_BYTES = 64 * 2**20
_MAX_FILE_BYTES = 2**40
_MAX_FILES = 200_000
Size = Annotated[int, Field(ge=0, le=2**50)]


class LockedFile(StoredRecord):
    """One file of the folder."""

    path: str  # relative, with forward slashes
    sha256: Digest
    size: Size
    licence: str = "unknown"
    source: str = ""


class LockedDownload(StoredRecord):
    """One fetched file or archive. `trust` is the origin of the digest."""

    name: str
    url: str
    sha256: Digest
    size: Size
    trust: Literal["published", "first-use"]


class Lock(StoredRecord):
    """The content of a lock file."""

    version: Literal[1] = 1
    files: tuple[LockedFile, ...] = ()
    downloads: tuple[LockedDownload, ...] = ()


@dataclass(frozen=True)
class Verification:
    """Differences from the lock file: relative paths, sorted."""

    checked: int
    missing: tuple[str, ...]
    changed: tuple[str, ...]
    unlisted: tuple[str, ...]

    @property
    def good(self) -> bool:
        """Whether every listed file exists unchanged; unlisted files are allowed."""
        return not self.missing and not self.changed


def sha256_of(path: Path) -> str:
    """The sha256 of a file's bytes, 64 hexadecimal digits."""
    with open_regular(path, _MAX_FILE_BYTES, "Restore the file, or fetch it again") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def locked_file(folder: Path, relative: str, licence: str, source: str) -> LockedFile:
    """The entry of a file as it is now."""
    path = folder / relative
    size = path.stat().st_size
    return LockedFile(path=relative, sha256=sha256_of(path), size=size, licence=licence, source=source)


def read_lock(folder: Path) -> Lock | None:
    """The folder's lock file, or None where there is none. Raises InputError for a damaged one."""
    path = folder / LOCK_NAME
    if not path.exists():
        return None
    data = read_regular(path, _MAX_LOCK_BYTES, "Remove it and write it again: datagen assets lock DIR")
    try:
        lock = Lock.model_validate_json(data)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(step) for step in first["loc"])
        raise InputError(
            path, field, first["msg"], "Restore it, or write it again: datagen assets lock DIR"
        ) from error
    for number, entry in enumerate(lock.files):
        pure = PurePosixPath(entry.path)
        if pure.is_absolute() or ".." in pure.parts or "\0" in entry.path or not entry.path:
            raise InputError(
                path,
                f"files.{number}.path",
                f"{entry.path[:80]!r} is outside the folder",
                "Restore the lock file",
            )
    return lock


def write_lock(folder: Path, lock: Lock) -> Path:
    """Replace the folder's lock file atomically."""
    path = folder / LOCK_NAME
    with whole_file(path, durable=True) as file:
        file.write(json.dumps(lock.model_dump(), indent=1, sort_keys=True).encode() + b"\n")
    return path


def lock(folder: Path, licence: str | None = None, source: str | None = None) -> Lock:
    """Lock all files as they are now. Licence and source of known files stay unless given."""
    before = read_lock(_folder(folder)) or Lock()
    known = {entry.path: (entry.licence, entry.source) for entry in before.files}
    files: list[LockedFile] = []
    for relative in _files(folder):
        old_licence, old_source = known.get(relative, ("unknown", ""))
        given = (old_licence if licence is None else licence, old_source if source is None else source)
        files.append(locked_file(folder, relative, *given))
    if not files:
        raise InputError(folder, "", "has no files to lock", "Name the folder of assets")
    after = Lock(files=tuple(files), downloads=before.downloads)
    write_lock(folder, after)
    return after


def verify(folder: Path) -> Verification:
    """Compare every listed file's size and sha256 with the folder. InputError without a lock file."""
    locked = read_lock(_folder(folder))
    if locked is None:
        raise InputError(folder, LOCK_NAME, "does not exist", "Write it: datagen assets lock DIR")
    missing: list[str] = []
    changed: list[str] = []
    for entry in locked.files:
        path = folder / entry.path
        if not path.is_file():
            missing.append(entry.path)
        elif path.stat().st_size != entry.size or sha256_of(path) != entry.sha256:
            changed.append(entry.path)
    listed = {entry.path for entry in locked.files}
    unlisted = [path for path in _files(folder) if path not in listed]
    return Verification(len(locked.files), tuple(sorted(missing)), tuple(sorted(changed)), tuple(unlisted))


def _folder(folder: Path) -> Path:
    if not folder.is_dir():
        raise InputError(folder, "", "does not exist", "Name the folder of assets")
    return folder


def _files(folder: Path) -> list[str]:
    """All files below a folder, relative and sorted, except hidden ones and the lock file."""
    found: list[str] = []
    for root, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        base = Path(root).relative_to(folder)
        found += [
            (base / name).as_posix() for name in names if not name.startswith(".") and name != LOCK_NAME
        ]
        if len(found) > _MAX_FILES:
            raise InputError(folder, "", f"has more than {_MAX_FILES:,} files", "Name the folder of assets")
    return sorted(found)

"""Where a run lives: a folder or an object-store prefix behind one small set of verbs.

Both are reached through obstore, so that a local run and a run on S3 follow one protocol: write,
make durable, and publish by a create-only put. Nothing relies on renaming what others can see.
"""

from __future__ import annotations

import errno
import os
import re
import secrets
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import obstore
from obstore.exceptions import AlreadyExistsError, BaseError
from obstore.store import LocalStore, from_url

from schemas.errors import InputError

_MENDS = {
    errno.ENOSPC: "Free disk space or write to another disk, then submit again: the run resumes",
    errno.EDQUOT: "Free disk space or raise the quota, then submit again: the run resumes",
    errno.EACCES: "Give yourself read and write permission there, or choose another folder",
    errno.EPERM: "Choose a folder on a file system that allows this (hard links, permissions)",
    errno.EROFS: "Choose a folder that can be written",
    errno.ENOTDIR: "A file stands where a folder is needed: remove it or choose another folder",
    errno.EISDIR: "A folder stands where a file is needed: remove it or choose another folder",
    errno.ENAMETOOLONG: "Choose a shorter path",
    errno.EMFILE: "Raise the limit of open files (ulimit -n)",
    errno.EIO: "Check the disk",
}
_OTHER_MEND = "Check that the place exists, is reachable and can be written"
_FAILURES = (BaseError, OSError, ValueError)


@dataclass(frozen=True)
class StoredFile:
    """One listed file: its key below the storage's root, its size in bytes, and its change stamp.

    Equal stamps of one key mean equal bytes: the store's entity tag, or what the file system notes of
    the file (inode, time and size). `modified_s` is when it was last written, in seconds since 1970 UTC.
    """

    key: str
    size: int
    stamp: str = ""
    modified_s: float = 0.0


class Storage:
    """Files under one root, named by keys with forward slashes.

    Every failure is an `InputError` that names the root, the key and the mend. `folder` is the
    root on this machine, or None when the storage is remote.
    """

    def __init__(self, url: str, store: Any, folder: Path | None) -> None:
        self.url = url
        self.folder = folder
        self._store = store

    def __reduce__(self) -> tuple[Any, tuple[str, bool]]:
        # Workers reopen it by address: connections do not cross process borders.
        return (open_storage, (self.url, False))

    def __repr__(self) -> str:
        return f"Storage({self.url!r})"

    def put(self, key: str, data: bytes) -> None:
        """Write a file whole; one of that name is replaced. Not durable before `sync`."""
        try:
            obstore.put(self._store, key, data, use_multipart=False)
        except _FAILURES as e:
            self._refuse(key, e)

    def below(self, key: str) -> Storage:
        """The storage whose root is a folder of this one."""
        if self.folder is None:
            return open_storage(f"{self.url}/{key}", probe=False)
        return _open_folder(self.folder / key, create=True)

    def put_new(self, key: str, data: bytes) -> bool:
        """Write a file durably unless the key exists; False when it does with other bytes.

        One racer wins. A store may write and yet answer with an error, and the repeated request then
        finds the key taken: by these very bytes, which is a success.
        """
        try:
            if self.folder is None:
                obstore.put(self._store, key, data, mode="create", use_multipart=False)
                return True
            # Locally the bytes must be on disk before the name is, or a power cut could leave an
            # empty file that counts. Linking fails when the name is taken.
            draft = f"{key}.{secrets.token_hex(8)}.part"
            try:
                obstore.put(self._store, draft, data, use_multipart=False)
                self.sync([draft])
                obstore.copy(self._store, draft, key, overwrite=False)
            finally:
                self.delete([draft])
            self.sync([key])
        except AlreadyExistsError:
            return self.get(key, 2**40) == data
        except InputError:
            raise
        except _FAILURES as e:
            self._refuse(key, e)
        return True

    def get(self, key: str, limit_bytes: int) -> bytes | None:
        """The file's bytes, or None when there is no such file. Refuses one above the limit."""
        try:
            found = obstore.get(self._store, key)
            size = int(found.meta["size"])
            if size > limit_bytes:
                raise InputError(
                    f"{self.url}/{key}",
                    "",
                    f"{size} bytes, more than the {limit_bytes} that such a file can have",
                    "It was not written by this program: restore the run from a copy, or remove the file",
                )
            return bytes(found.bytes())
        except FileNotFoundError:
            return None
        except InputError:
            raise
        except _FAILURES as e:
            self._refuse(key, e)

    def exists(self, key: str) -> bool:
        """Whether the file exists."""
        try:
            obstore.head(self._store, key)
        except FileNotFoundError:
            return False
        except _FAILURES as e:
            self._refuse(key, e)
        return True

    def list(self, prefix: str) -> Iterator[StoredFile]:
        """All files below a folder (a prefix without its closing slash), in no special order."""
        try:
            for group in obstore.list(self._store, prefix):
                for entry in group:
                    modified_s = entry["last_modified"].timestamp()
                    yield StoredFile(str(entry["path"]), int(entry["size"]), _stamp(entry), modified_s)
        except _FAILURES as e:
            self._refuse(prefix, e)

    def delete(self, keys: Iterable[str]) -> None:
        """Remove files; those that do not exist are passed over."""
        for key in keys:
            try:
                obstore.delete(self._store, key)
            except FileNotFoundError:
                continue
            except _FAILURES as e:
                self._refuse(key, e)

    def link_or_copy(self, source: str, target: str) -> None:
        """A second name for the same bytes: a hard link locally, a copy by the server elsewhere."""
        try:
            if self.folder is None:
                obstore.copy(self._store, source, target)
                return
            path = self.folder / target
            path.parent.mkdir(parents=True, exist_ok=True)
            os.link(self.folder / source, path)
        except _FAILURES as e:
            self._refuse(target, e)

    def put_many(self, files: Mapping[str, bytes]) -> None:
        """Write many files whole, as `put` does each; remote storage takes several at once."""
        for key, data in files.items():
            self.put(key, data)

    def get_many(self, keys: Iterable[str], limit_bytes: int) -> Iterator[tuple[str, bytes | None]]:
        """(key, bytes) of many files, as `get` gives each, in the order of the keys."""
        for key in keys:
            yield key, self.get(key, limit_bytes)

    def adopt(self, source: Storage, source_key: str, key: str, limit_bytes: int = 2**31) -> None:
        """Take over a file of another storage; one of that name is replaced. Not durable before `sync`.

        No byte is moved where it can be helped: a hard link on one file system. InputError when there
        is no such file, or where bytes must be moved and they are more than the limit.
        """
        if self.folder is not None and source.folder is not None:
            path = self.folder / key
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.unlink(missing_ok=True)
                os.link(source.folder / source_key, path)
                return
            except OSError as e:
                if e.errno not in (errno.EXDEV, errno.EPERM, errno.EMLINK, errno.ENOTSUP):
                    self._refuse(key, e)
        data = source.get(source_key, limit_bytes)
        if data is None:
            raise InputError(f"{source.url}/{source_key}", "", "no such file", "Restore it from a copy")
        self.put(key, data)

    def sync(self, keys: Iterable[str]) -> None:
        """Make files and the folders that name them survive a power cut.

        Locally this calls fsync on each file and on each folder up to the root; an object store
        has already done it when a put returns.
        """
        if self.folder is None:
            return
        folders: set[Path] = set()
        try:
            for key in keys:
                path = self.folder / key
                _fsync(path)
                for parent in path.parents:
                    folders.add(parent)
                    if parent == self.folder:
                        break
            for folder in sorted(folders, reverse=True):  # leaves first
                _fsync(folder)
        except OSError as e:
            raise storage_error(e.filename or self.url, e) from e

    def _refuse(self, key: str, error: Exception) -> NoReturn:
        raise storage_error(f"{self.url}/{key}" if key else self.url, error) from error


def _stamp(entry: Mapping[str, Any]) -> str:
    return str(entry["e_tag"] or f"{entry['last_modified'].isoformat()}-{entry['size']}")


def storage_error(place: str | Path, error: Exception) -> InputError:
    """The one-line error for a failed file operation, with the mend that its errno asks for."""
    text = str(error).split("\n\nDebug source:", 1)[0]
    code = getattr(error, "errno", None)
    if code is None and (found := re.search(r"\(os error (\d+)\)", text)):
        code = int(found.group(1))
    problem = os.strerror(code) if code is not None else text
    return InputError(place, "", problem, _MENDS.get(code or 0, _OTHER_MEND))


def open_storage(place: str | Path, probe: bool = True, create: bool = True) -> Storage:
    """Storage at a folder or a URL (`s3://bucket/prefix`).

    With `probe`, it is refused unless a create-only put gives exactly one winner: commits rest on
    that. With `create`, a missing folder is made; without, it is an error.
    """
    text = str(place)
    if "\0" in text or not text.strip():
        raise InputError(repr(text), "", "not the name of a folder", "Name a folder or an s3:// address")
    if "://" in text and not text.startswith("file://"):
        storage = _open_remote(text)
    else:
        storage = _open_folder(Path(text.removeprefix("file://")).expanduser().absolute(), create)
    if probe:
        _probe(storage)
    return storage


def _open_folder(folder: Path, create: bool) -> Storage:
    try:
        if create:
            folder.mkdir(parents=True, exist_ok=True)
        if not folder.is_dir():
            problem = "not a folder" if folder.exists() else "no such folder"
            raise InputError(folder, "", problem, "Name the folder of a run")
        return Storage(str(folder), LocalStore(folder), folder)
    except FileExistsError as e:
        raise InputError(folder, "", "a file stands there", "Name a folder that is new or holds a run") from e
    except InputError:
        raise
    except _FAILURES as e:
        raise storage_error(folder, e) from e


def _open_remote(url: str) -> Storage:
    try:
        return Storage(url.rstrip("/"), from_url(url), None)
    except _FAILURES as e:
        raise InputError(
            url, "", storage_error(url, e).args[0], "Name a folder or an s3:// address that you can write"
        ) from e


def _probe(storage: Storage) -> None:
    key = f".probe-{secrets.token_hex(8)}"
    try:
        if not storage.put_new(key, b"first") or storage.put_new(key, b"second"):
            raise InputError(
                storage.url,
                "",
                "create-only writes are not honoured here, so two jobs could overwrite each other",
                "Use a local disk or an object store with conditional writes",
            )
    finally:
        storage.delete([key])


def _fsync(path: Path) -> None:
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)

"""Storage of a run: a local folder or an object-store prefix, behind one small interface.

Local and S3 runs follow one protocol: write, make durable, and publish by a create-only put. No visible
file is renamed.
"""

from __future__ import annotations

import re
import secrets
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from datagen.schemas.errors import InputError, refuse_not_utf8
from datagen.schemas.storage.errors import FileTooLarge, storage_error
from datagen.schemas.storage.local_files import LocalFiles, StoredFile

if TYPE_CHECKING:
    from datagen.schemas.storage.remote_objects import RemoteObjects

__all__ = ["Storage", "StoredFile", "open_storage", "storage_error"]

# Relative names without `..`, empty parts or control characters.
_KEY = re.compile(r"(?!\.{0,2}(?:/|\Z))(?:[^/\x00-\x1f\x7f\\]+(?:/(?!\.{0,2}(?:/|\Z))|\Z))+")

_AT_ONCE = 16  # concurrent requests of this process

Result = TypeVar("Result")
Item = TypeVar("Item")


class Storage:
    """Files under one root, named by keys with forward slashes.

    Every failure is an `InputError` with the root, the key and the fix, also for keys that are absolute, have
    empty parts or contain `..`. `folder` is the root on this machine, None for remote storage. On a disk,
    symbolic links below the root are not followed, and pipes and devices are refused.
    """

    def __init__(self, files: LocalFiles | RemoteObjects) -> None:
        self._files = files
        local = isinstance(files, LocalFiles)
        self.folder: Path | None = files.folder if local else None
        self.url = str(files.folder) if local else files.url

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        # Workers reopen it by address: connections cannot be pickled.
        if isinstance(self._files, LocalFiles):
            return (_local, (self._files.root, self._files.prefix))
        return (open_storage, (self.url, False))

    def __repr__(self) -> str:
        return f"Storage({self.url!r})"

    def below(self, key: str) -> Storage:
        """The storage of a subfolder, which need not exist."""
        return Storage(self._files.below(_checked(self.url, key)))

    def put(self, key: str, data: bytes, durably: bool = True) -> None:
        """Write a file, or replace it; after a power cut the name has the old bytes or the new ones.

        Not so where it is written without `durably`: then it may be torn.
        """
        self._try(key, lambda: self._files.put(key, data, durably))

    def put_new(self, key: str, data: bytes) -> bool:
        """Write a file durably unless the key exists; False where it exists with other bytes.

        One of several racing writers wins. Where a store wrote the file but responded with an error, the
        repeated request finds the key with these bytes, which counts as a success.
        """
        if self._try(key, lambda: self._files.create(key, data)):
            return True
        try:
            same = self._try(key, lambda: self._files.get(key, len(data))) == data
        except FileTooLarge:
            return False
        if same and isinstance(files := self._files, LocalFiles):
            self._try(key, lambda: files.sync(key))  # its writer may have stopped before
        return same

    def get(self, key: str, limit_bytes: int) -> bytes | None:
        """The file's bytes, or None where it does not exist. InputError above the limit."""
        return self._try(key, lambda: self._files.get(key, limit_bytes))

    def get_range(self, key: str, start: int, size: int) -> bytes | None:
        """`size` bytes of a file from `start`, counted from its end where negative; None without the file.

        Fewer bytes where the file ends before.
        """
        return self._try(key, lambda: self._files.get_range(key, start, size))

    def get_many(self, keys: Iterable[str], limit_bytes: int) -> Iterator[tuple[str, bytes | None]]:
        """Yield (key, bytes) of many files as `get` does, in the order of keys; some tens are in memory."""
        return self.concurrent_map(lambda key: (key, self.get(key, limit_bytes)), keys)

    def concurrent_map(self, do: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Yield `do(item)`, which uses this storage, for each item in order; the first exception ends it.

        Calls are concurrent for remote storage, so `do` must not use the methods for many files. No call
        is running after the iterator has ended.
        """
        if isinstance(self._files, LocalFiles):
            return map(do, items)
        return concurrent_map(_threads(), _AT_ONCE, do, items)

    def exists(self, key: str) -> bool:
        return self._try(key, lambda: self._files.exists(key))

    def list(self, prefix: str) -> Iterator[StoredFile]:
        """All files below a folder (a prefix without its closing slash), in no special order."""
        if prefix:
            _checked(self.url, prefix)
        try:
            yield from self._files.list(prefix)
        except OSError as e:
            raise storage_error(f"{self.url}/{prefix}" if prefix else self.url, e) from e

    def delete(self, keys: Iterable[str]) -> None:
        """Remove files; missing ones are ignored."""
        if isinstance(self._files, LocalFiles):
            for key in keys:
                self._try(key, lambda key=key: self._files.delete([key]))
        else:
            self._files.delete(_checked(self.url, key) for key in keys)

    def remove_empty(self, folder: str) -> None:
        """Remove a folder without files; object stores have no folders."""
        files = self._files
        if isinstance(files, LocalFiles):
            self._try(folder, lambda: files.remove_empty(folder))

    def _try(self, key: str, do: Callable[[], Result]) -> Result:
        _checked(self.url, key)
        try:
            return do()
        except OSError as e:
            raise storage_error(f"{self.url}/{key}", e) from e


def open_storage(path: str | Path, probe: bool = True, create: bool = True) -> Storage:
    """Open the storage at a folder or a URL (`s3://bucket/prefix`).

    With `probe`, InputError unless create-only puts work, which commits depend on. With `create`, a missing
    folder is created; without, it is an error.
    """
    text = str(path)
    if "\0" in text or not text.strip():
        raise InputError(repr(text), "", "is not the name of a folder", "Name a folder or an s3:// address")
    if text.startswith("s3:") and not text.startswith("s3://"):  # a typing error that would become a folder
        raise InputError(text[:200], "", "does not name a bucket", "Give s3://bucket/prefix")
    scheme, colon, rest = text.partition("://")
    if colon and scheme == "s3":
        # Imported here: local runs need no client.
        from datagen.schemas.storage.remote_objects import RemoteObjects

        storage = Storage(RemoteObjects(text))
    elif colon and scheme != "file":
        fix = "Name a folder or an s3:// address that you can write"
        raise InputError(f"{scheme}://...", "", "is neither a folder nor an s3:// address", fix)
    else:
        folder = Path(rest if colon else text).expanduser().absolute()
        refuse_not_utf8(str(folder))  # records contain it
        storage = _open_folder(folder, create)
    if probe:
        _probe(storage)
    return storage


def _open_folder(folder: Path, create: bool) -> Storage:
    try:
        if create:
            LocalFiles.make_root(folder)
        if not folder.is_dir():
            problem = "not a folder" if folder.exists() else "no such folder"
            raise InputError(folder, "", problem, "Name the folder of a run")
        return _local(folder, ())
    except FileExistsError as e:
        raise InputError(folder, "", "is a file", "Name a new folder, or the folder of a run") from e
    except OSError as e:
        raise storage_error(folder, e) from e


def _local(root: Path, prefix: tuple[str, ...]) -> Storage:
    return Storage(LocalFiles(root, prefix))


def _probe(storage: Storage) -> None:
    key = f".probe-{secrets.token_hex(8)}"
    try:
        if not storage.put_new(key, b"first") or storage.put_new(key, b"second"):
            problem = "does not support create-only writes, so two jobs could overwrite each other"
            fix = "Use a local disk or an object store with conditional writes"
            raise InputError(storage.url, "", problem, fix)
    finally:
        storage.delete([key])


def _checked(url: str, key: str) -> str:
    if not _KEY.fullmatch(key):
        problem = "is not the name of a file below the root"
        raise InputError(f"{url}/{key!r}"[:300], "", problem, "Remove the record that names it")
    return key


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="store")


def concurrent_map(
    pool: ThreadPoolExecutor, most: int, do: Callable[[Item], Result], items: Iterable[Item]
) -> Generator[Result]:
    """Yield `do(item)` for each item in order, with a bounded number of results computed ahead.

    The first exception ends it; no call is running after the iterator has ended. `items` is consumed in the
    caller's thread, as needed. `do` must not wait for the pool that it runs in.
    """
    begun, left = deque[Future[Result]](), iter(items)
    try:
        while True:
            begun.extend(pool.submit(do, item) for item in islice(left, most - len(begun)))
            if not begun:
                return
            result = begun[0].result()
            begun.popleft()
            yield result
    finally:
        for future in begun:
            future.cancel()
        wait(begun)

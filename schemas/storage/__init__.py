"""Where a run lives: a folder or an object-store prefix behind one small set of verbs.

A local run and a run on S3 follow one protocol: write, make durable, and publish by a create-only put.
Nothing relies on renaming what others can see.
"""

from __future__ import annotations

import re
import secrets
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from datagen.schemas.concurrent_map import concurrent_map
from datagen.schemas.errors import InputError, refuse_not_utf8
from datagen.schemas.storage.errors import FileTooLarge, storage_error
from datagen.schemas.storage.local_files import LocalFiles
from datagen.schemas.storage.stored_file import StoredFile

if TYPE_CHECKING:
    from datagen.schemas.storage.remote_objects import RemoteObjects

__all__ = ["Storage", "StoredFile", "open_storage", "storage_error"]

# Names without end parts: no way up, no way to the root, nothing that a terminal would act on.
_KEY = re.compile(r"(?!\.{0,2}(?:/|\Z))(?:[^/\x00-\x1f\x7f\\]+(?:/(?!\.{0,2}(?:/|\Z))|\Z))+")

_AT_ONCE = 16  # requests under way in this process

Result = TypeVar("Result")
Item = TypeVar("Item")


class Storage:
    """Files under one root, named by keys with forward slashes.

    Every failure is an `InputError` that names the root, the key and the mend; so is a key that is
    absolute, has empty parts or leads up. `folder` is the root on this machine, or None when the storage
    is remote. On a disk no symbolic link below the root is followed, and pipes and devices are refused.
    """

    def __init__(self, files: LocalFiles | RemoteObjects) -> None:
        self._files = files
        local = isinstance(files, LocalFiles)
        self.folder: Path | None = files.folder if local else None
        self.url = str(files.folder) if local else files.url

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        # Workers reopen it by address: connections do not cross process borders.
        if isinstance(self._files, LocalFiles):
            return (_local, (self._files.root, self._files.prefix))
        return (open_storage, (self.url, False))

    def __repr__(self) -> str:
        return f"Storage({self.url!r})"

    def below(self, key: str) -> Storage:
        """The storage whose root is a folder of this one, which need not exist."""
        return Storage(self._files.below(_checked(self.url, key)))

    def put(self, key: str, data: bytes) -> None:
        """Write a file whole; one of that name is replaced. Not durable before `sync`."""
        self._try(key, lambda: self._files.put(key, data))

    def put_many(self, files: Mapping[str, bytes]) -> None:
        """Write many files whole, as `put` does each; remote storage takes several at once."""
        for key in files:
            _checked(self.url, key)
        _exhaust(self.concurrent_map(lambda item: self.put(*item), files.items()))

    def put_new(self, key: str, data: bytes) -> bool:
        """Write a file durably unless the key exists; False when it does with other bytes.

        One racer wins. A store may write and yet answer with an error, and the repeated request then
        finds the key taken: by these very bytes, which is a success.
        """
        if self._try(key, lambda: self._files.create(key, data)):
            return True
        try:
            same = self._try(key, lambda: self._files.get(key, len(data))) == data
        except FileTooLarge:
            return False
        if same:
            self.sync([key])  # whoever wrote it may not have come so far
        return same

    def get(self, key: str, limit_bytes: int) -> bytes | None:
        """The file's bytes, or None when there is no such file. Refuses one above the limit."""
        return self._try(key, lambda: self._files.get(key, limit_bytes))

    def get_many(self, keys: Iterable[str], limit_bytes: int) -> Iterator[tuple[str, bytes | None]]:
        """(key, bytes) of many files, as `get` gives each, in the order of the keys.

        Remote storage reads several at once; at most some tens of files are held.
        """
        return self.concurrent_map(lambda key: (key, self.get(key, limit_bytes)), keys)

    def concurrent_map(self, do: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """What `do`, which asks this storage, gives for each item, in their order; the first failure ends it.

        Remote storage is asked several things at once, so that `do` must use none of the verbs for many.
        None of them is under way any more when the iterator has ended.
        """
        if isinstance(self._files, LocalFiles):
            return map(do, items)
        return concurrent_map(_threads(), _AT_ONCE, do, items)

    def exists(self, key: str) -> bool:
        """Whether the file exists."""
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
        """Remove files; those that do not exist are passed over."""
        if isinstance(self._files, LocalFiles):
            for key in keys:
                self._try(key, lambda key=key: self._files.delete([key]))
        else:
            self._files.delete(_checked(self.url, key) for key in keys)

    def remove_empty(self, folder: str) -> None:
        """Remove a folder in which no file is left; object stores have none."""
        files = self._files
        if isinstance(files, LocalFiles):
            self._try(folder, lambda: files.remove_empty(folder))

    def link_or_copy(self, source: str, target: str) -> None:
        """A second name for the same bytes; one of that name is replaced. See `adopt`."""
        self.adopt(self, source, target)

    def adopt(self, source: Storage, source_key: str, key: str, limit_bytes: int = 2**31) -> None:
        """Take over a file of another storage; one of that name is replaced. Not durable before `sync`.

        No byte is moved where it can be helped: a hard link on one file system, else a copy; a copy by
        the server within one bucket. Else the file is read and written here. InputError when there is no
        such file, or when bytes that must be read are more than the limit.
        """
        _checked(source.url, source_key)
        ours, theirs = self._files, source._files
        try:
            if isinstance(ours, LocalFiles) and isinstance(theirs, LocalFiles):
                self._try(key, lambda: ours.take(theirs, source_key, key), passes=FileNotFoundError)
            elif isinstance(ours, LocalFiles) or isinstance(theirs, LocalFiles):
                data = source.get(source_key, limit_bytes)
                if data is None:
                    raise FileNotFoundError
                self.put(key, data)
            else:
                self._try(
                    key, lambda: ours.take(theirs, source_key, key, limit_bytes), passes=FileNotFoundError
                )
        except FileNotFoundError as e:
            mend = "Restore the file from a copy"
            raise InputError(f"{source.url}/{source_key}", "", "no such file", mend) from e

    def adopt_many(self, source: Storage, pairs: Iterable[tuple[str, str]], limit_bytes: int = 2**31) -> None:
        """Take over many files of another storage, given as (its key, key here), as `adopt` does each.

        Where one of the two is remote, several are under way at once.
        """
        asked = source if isinstance(self._files, LocalFiles) else self
        _exhaust(asked.concurrent_map(lambda pair: self.adopt(source, *pair, limit_bytes), pairs))

    def sync(self, keys: Iterable[str]) -> None:
        """Make files and the folders that name them survive a power cut.

        Locally this calls fsync on each file and on each folder up to the root; an object store
        has already done it when a put returns.
        """
        files = self._files
        if isinstance(files, LocalFiles):
            files.sync(_checked(self.url, key) for key in keys)

    def _try(self, key: str, do: Callable[[], Result], passes: type[OSError] | tuple[()] = ()) -> Result:
        _checked(self.url, key)
        try:
            return do()
        except passes:
            raise
        except OSError as e:
            raise storage_error(f"{self.url}/{key}", e) from e


def open_storage(place: str | Path, probe: bool = True, create: bool = True) -> Storage:
    """Storage at a folder or a URL (`s3://bucket/prefix`).

    With `probe`, it is refused unless a create-only put gives exactly one winner: commits rest on
    that. With `create`, a missing folder is made; without, it is an error.
    """
    text = str(place)
    if "\0" in text or not text.strip():
        raise InputError(repr(text), "", "not the name of a folder", "Name a folder or an s3:// address")
    if text.startswith("s3:") and not text.startswith("s3://"):  # a slip that would become a folder here
        raise InputError(text[:200], "", "does not name a bucket", "Give s3://bucket/prefix")
    scheme, colon, rest = text.partition("://")
    if colon and scheme == "s3":
        # Loaded here: who works on a disk does not wait for the client.
        from datagen.schemas.storage.remote_objects import RemoteObjects

        storage = Storage(RemoteObjects(text))
    elif colon and scheme != "file":
        problem = "neither a folder nor an s3:// address"
        raise InputError(
            f"{scheme}://...", "", problem, "Name a folder or an s3:// address that you can write"
        )
    else:
        folder = Path(rest if colon else text).expanduser().absolute()
        refuse_not_utf8(str(folder))  # records name it
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
        raise InputError(folder, "", "a file stands there", "Name a folder that is new or holds a run") from e
    except OSError as e:
        raise storage_error(folder, e) from e


def _local(root: Path, prefix: tuple[str, ...]) -> Storage:
    return Storage(LocalFiles(root, prefix))


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


def _checked(url: str, key: str) -> str:
    if not _KEY.fullmatch(key):
        problem = "not the name of a file below the root"
        raise InputError(f"{url}/{key!r}"[:300], "", problem, "Remove what names it")
    return key


def _exhaust(results: Iterator[None]) -> None:
    deque(results, maxlen=0)


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="store")

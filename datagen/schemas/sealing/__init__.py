"""Seal runs: one flat Zarr v3 store over the committed shards, which any Zarr reader opens.

Chunks are the shards' files (hard links, or copies by the object store's server), so no data is encoded;
metadata is new. Shards are packed in order, and rows beyond the end are cut by the arrays' shape.
"""

from __future__ import annotations

import ctypes
import os
import secrets
import shutil
import stat
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from datagen.schemas.errors import InputError
from datagen.schemas.fields import Field
from datagen.schemas.safe_files import sync_folder
from datagen.schemas.sealing.contents import (
    ROOT,
    SEALED,
    Contents,
    SealedPart,
    SealedRoot,
    read_contents,
    sealed_metadata,
    sealed_root,
)
from datagen.schemas.storage import Storage, storage_error
from datagen.schemas.storage.errors import CANNOT_EXCHANGE, TAKEN

__all__ = ["SEALED", "SealedPart", "SealedRoot", "seal", "sealed_metadata", "sealed_root", "unseal"]

_AT_FDCWD = -100
_RENAME_EXCHANGE = 2


def seal(storage: Storage) -> str:
    """Make data.zarr over the committed shards of the run, or merged runs, in `storage`; return its address.

    Quarantined and missing shards are omitted. An older store is replaced atomically; linked files become
    read-only. InputError when no shard is committed, a committed file is missing or of another size, merged
    runs have different arrays, or the disk or the server fails.
    """
    contents = read_contents(storage)
    metadata = sealed_metadata(contents)
    if storage.folder is not None:
        _seal_folder(contents, storage.folder, metadata)
    else:
        _seal_prefix(contents, metadata)
    return f"{storage.url}/{SEALED}"


def unseal(storage: Storage) -> None:
    """Remove data.zarr in `storage`, if any. The shards' files are kept. InputError as `seal`."""
    if storage.folder is not None:
        _unseal_folder(storage.folder)
    else:
        _unseal_prefix(storage)


def _seal_folder(contents: Contents, folder: Path, metadata: Mapping[str, bytes]) -> None:
    """Make `folder`/data.zarr from the chunks of the contents and the metadata, atomically.

    The store is written durably as data.zarr.<hex>.partial and then renamed. An existing store is exchanged
    with it in one step (Linux: renameat2), so that there is always a complete store; where that is not
    supported, the old one is renamed first, and a kill between the two renames leaves none. InputError when
    the disk fails.
    """
    draft, storage = _draft_of(folder), contents.storage
    try:
        files = {f"{draft.name}/{path}": data for path, data in metadata.items()}
        storage.put_many(files)
        for _, field in contents.schema.fields:
            _link(contents, field, draft)
        storage.sync(files)  # with every folder of the store, since each has metadata
        old = _publish(draft, folder / SEALED)
        sync_folder(folder)
        _remove_tree(old)
    except OSError as e:
        raise storage_error(e.filename or draft, e) from e
    finally:
        _remove_tree(draft)


def _unseal_folder(folder: Path) -> None:
    """Remove `folder`/data.zarr: rename it, then delete it. InputError when the disk fails."""
    draft = _draft_of(folder)
    try:
        (folder / SEALED).rename(draft)
        sync_folder(folder)
    except FileNotFoundError:
        pass  # there is none, or another process was first
    except OSError as e:
        raise storage_error(folder / SEALED, e) from e
    finally:
        _remove_tree(draft)


def _draft_of(folder: Path) -> Path:
    """A new name for an incomplete or replaced store; `verify --clean` removes such names."""
    return folder / f"{SEALED}.{secrets.token_hex(8)}.partial"


def _remove_tree(path: Path) -> None:
    """Remove a folder, a file or a link as far as possible."""
    if path.is_symlink() or path.is_file():
        path.unlink(missing_ok=True)
    else:
        shutil.rmtree(path, ignore_errors=True)


def _link(contents: Contents, field: Field, draft: Path) -> None:
    for _, source, name in contents.chunks(field):
        contents.storage.adopt(contents.storage, source, f"{draft.name}/{field.name}/{name}")
        target = draft / field.name / name
        mode = target.lstat().st_mode
        if not stat.S_ISREG(mode):
            address = f"{contents.storage.url}/{source}"
            raise InputError(address, "", "is not a regular file", "Restore the file from a copy")
        if mode & 0o777 != 0o444:
            target.chmod(0o444)


def _publish(draft: Path, sealed: Path) -> Path:
    """Rename the finished store; return the new name of an older one.

    Another process may seal or unseal the run at any moment.
    """
    while True:
        try:
            draft.rename(sealed)  # onto nothing, or onto an empty folder
            return draft
        except OSError as e:
            if e.errno not in TAKEN:
                raise
        with suppress(FileNotFoundError):
            if _exchange(draft, sealed):
                return draft
            old = _draft_of(sealed.parent)
            sealed.rename(old)
            try:
                draft.rename(sealed)
                return old
            except OSError as e:
                if e.errno not in TAKEN:
                    old.rename(sealed)
                    raise
                _remove_tree(old)


def _exchange(one: Path, other: Path) -> bool:
    """Exchange the names of two files or folders atomically; False where that is not supported."""
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if rename is None:
        return False
    if rename(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in CANNOT_EXCHANGE:
        return False
    raise OSError(code, os.strerror(code), str(one), None, str(other))


def _seal_prefix(contents: Contents, metadata: Mapping[str, bytes]) -> None:
    """Make data.zarr from the chunks of the contents and the metadata, root last.

    A store whose shards are the first of the new one stays readable: chunks are added, and the root is
    replaced. Any other store is removed first, root first. A kill leaves the old store, the new one, or none;
    objects without a root do not count.
    """
    storage = contents.storage
    old = sealed_root(storage)
    kept = contents.digests.index(old.rows_sha256) if old and old.rows_sha256 in contents.digests else 0
    if not kept:
        _unseal_prefix(storage)
    _copy_chunks(contents, kept, tidy=True)
    storage.put_many({f"{SEALED}/{path}": data for path, data in metadata.items() if path != ROOT})
    storage.put(f"{SEALED}/{ROOT}", metadata[ROOT])
    # Another process that seals or unseals may have removed chunks before the root was written: copy them
    # again. Another seal does the same for its own store.
    _copy_chunks(contents, len(contents.shards), tidy=False)


def _unseal_prefix(storage: Storage) -> None:
    """Remove data.zarr: its root, then the arrays' metadata, then the chunks, so that it is never readable
    in part."""
    storage.delete([f"{SEALED}/{ROOT}"])
    storage.delete([f.key for f in storage.list(SEALED) if f.key.endswith(f"/{ROOT}")])
    storage.delete(f.key for f in storage.list(SEALED))


def _copy_chunks(contents: Contents, kept: int, tidy: bool) -> None:
    """Copy all chunks except those of the first `kept` shards; `tidy` removes objects that are no chunks.

    Chunks of a killed seal beyond those may belong to other shards, and are copied again.
    """
    for _, field in contents.schema.fields:
        odd = _copy_array(contents, field, kept)
        if tidy:
            contents.storage.delete(odd)


def _copy_array(contents: Contents, field: Field, kept: int) -> list[str]:
    """Copy an array's chunks; return the keys of other objects."""
    storage, folder = contents.storage, f"{SEALED}/{field.name}"
    there = {f.key.removeprefix(f"{folder}/") for f in storage.list(folder)} - {ROOT}

    def missing() -> Iterator[tuple[str, str]]:
        for position, source, name in contents.chunks(field):
            if not (name in there and position < kept):
                yield source, f"{folder}/{name}"
            there.discard(name)

    storage.adopt_many(storage, missing())
    return [f"{folder}/{name}" for name in sorted(there)]

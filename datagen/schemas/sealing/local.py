"""A sealed store on a local disk: hard links to the shards' files, published by one rename."""

from __future__ import annotations

import ctypes
import os
import secrets
import shutil
import stat
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from datagen.schemas.errors import InputError
from datagen.schemas.fields import Field
from datagen.schemas.sealing.contents import Contents
from datagen.schemas.sealing.metadata import SEALED
from datagen.schemas.storage import storage_error
from datagen.schemas.storage.errors import CANNOT_EXCHANGE, TAKEN
from datagen.schemas.whole_files import sync_folder

_AT_FDCWD = -100
_RENAME_EXCHANGE = 2


def seal_folder(contents: Contents, folder: Path, metadata: Mapping[str, bytes]) -> None:
    """Make `folder`/data.zarr from the chunks of the contents and the metadata, atomically.

    The store is written durably as data.zarr.<hex>.partial and then renamed. An existing store is exchanged
    with it in one step (Linux: renameat2), so that there is always a complete store; where that is not
    supported, the old one is renamed first, and a kill between the two renames leaves none. InputError when
    the disk fails.
    """
    draft, storage = draft_of(folder), contents.storage
    try:
        files = {f"{draft.name}/{path}": data for path, data in metadata.items()}
        storage.put_many(files)
        for _, field in contents.schema.fields:
            _link(contents, field, draft)
        storage.sync(files)  # with every folder of the store, since each has metadata
        old = _publish(draft, folder / SEALED)
        sync_folder(folder)
        remove_tree(old)
    except OSError as e:
        raise storage_error(e.filename or draft, e) from e
    finally:
        remove_tree(draft)


def unseal_folder(folder: Path) -> None:
    """Remove `folder`/data.zarr: rename it, then delete it. InputError when the disk fails."""
    draft = draft_of(folder)
    try:
        (folder / SEALED).rename(draft)
        sync_folder(folder)
    except FileNotFoundError:
        pass  # there is none, or another process was first
    except OSError as e:
        raise storage_error(folder / SEALED, e) from e
    finally:
        remove_tree(draft)


def draft_of(folder: Path) -> Path:
    """A new name for an incomplete or replaced store; `verify --clean` removes such names."""
    return folder / f"{SEALED}.{secrets.token_hex(8)}.partial"


def remove_tree(path: Path) -> None:
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
            old = draft_of(sealed.parent)
            sealed.rename(old)
            try:
                draft.rename(sealed)
                return old
            except OSError as e:
                if e.errno not in TAKEN:
                    old.rename(sealed)
                    raise
                remove_tree(old)


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

"""Seal runs: one flat Zarr v3 store over the committed shards, which any Zarr reader opens.

Chunks are the shards' files (hard links, or copies by the object store's server), so no data is encoded;
metadata is new. Shards are packed in order, and rows beyond the end are cut by the arrays' shape.
"""

from __future__ import annotations

from datagen.schemas.sealing.contents import read_contents
from datagen.schemas.sealing.local import seal_folder, unseal_folder
from datagen.schemas.sealing.metadata import SEALED, SealedPart, SealedRoot, sealed_metadata, sealed_root
from datagen.schemas.storage import Storage

__all__ = ["SEALED", "SealedPart", "SealedRoot", "seal", "sealed_metadata", "sealed_root", "unseal"]


def seal(storage: Storage) -> str:
    """Make data.zarr over the committed shards of the run, or merged runs, in `storage`; return its address.

    Quarantined and missing shards are omitted. An older store is replaced atomically; linked files become
    read-only. InputError when no shard is committed, a committed file is missing or of another size, merged
    runs have different arrays, or the disk or the server fails.
    """
    contents = read_contents(storage)
    metadata = sealed_metadata(contents)
    if storage.folder is not None:
        seal_folder(contents, storage.folder, metadata)
    else:
        # Imported here: local runs need no client of object stores.
        from datagen.schemas.sealing.remote import seal_prefix

        seal_prefix(contents, metadata)
    return f"{storage.url}/{SEALED}"


def unseal(storage: Storage) -> None:
    """Remove data.zarr in `storage`, if any. The shards' files are kept. InputError as `seal`."""
    if storage.folder is not None:
        unseal_folder(storage.folder)
    else:
        from datagen.schemas.sealing.remote import unseal_prefix

        unseal_prefix(storage)

"""Seal: one flat Zarr v3 store over the committed shards, which stock readers open.

Chunks are the shards' files (hard links, or copies by an object store's server), so sealing encodes
nothing; metadata is new. Shards are packed in order, and rows beyond the end are cut by the arrays'
shape alone.
"""

from __future__ import annotations

from datagen.schemas.sealing.contents import read_contents
from datagen.schemas.sealing.local import seal_folder, unseal_folder
from datagen.schemas.sealing.metadata import SEALED, SealedPart, SealedRoot, sealed_metadata, sealed_root
from datagen.schemas.storage import Storage

__all__ = ["SEALED", "SealedPart", "SealedRoot", "seal", "sealed_metadata", "sealed_root", "unseal"]


def seal(place: Storage) -> str:
    """Lay data.zarr over the committed shards of the run, or of the merged runs, at `place`; its address.

    Shards in quarantine or undone are left out. An older store is replaced whole, or stays whole; linked
    files become read-only. InputError when nothing is committed, a committed file is missing or of another
    size, merged runs have other arrays, or the disk or the server refuses.
    """
    contents = read_contents(place)
    metadata = sealed_metadata(contents)
    if place.folder is not None:
        seal_folder(contents, place.folder, metadata)
    else:
        # Loaded here: who works on a disk does not wait for the client of object stores.
        from datagen.schemas.sealing.remote import seal_prefix

        seal_prefix(contents, metadata)
    return f"{place.url}/{SEALED}"


def unseal(place: Storage) -> None:
    """Remove data.zarr at `place`, where there is one. The shards' files stay. InputError as `seal`."""
    if place.folder is not None:
        unseal_folder(place.folder)
    else:
        from datagen.schemas.sealing.remote import unseal_prefix

        unseal_prefix(place)

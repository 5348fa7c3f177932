"""A sealed store in an object store: server-side copies of the chunks, published by the root zarr.json.

Objects cannot be renamed, so the root publishes the store: without it `zarr.open` finds none, and only its
consolidated metadata has the lengths of the arrays.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from datagen.schemas.fields import Field
from datagen.schemas.sealing.contents import Contents
from datagen.schemas.sealing.metadata import ROOT, SEALED, sealed_root
from datagen.schemas.storage import Storage


def seal_prefix(contents: Contents, metadata: Mapping[str, bytes]) -> None:
    """Make data.zarr from the chunks of the contents and the metadata, root last.

    A store whose shards are the first of the new one stays readable: chunks are added, and the root is
    replaced. Any other store is removed first, root first. A kill leaves the old store, the new one, or none;
    objects without a root do not count.
    """
    storage = contents.storage
    old = sealed_root(storage)
    kept = contents.digests.index(old.rows_sha256) if old and old.rows_sha256 in contents.digests else 0
    if not kept:
        unseal_prefix(storage)
    _copy_chunks(contents, kept, tidy=True)
    storage.put_many({f"{SEALED}/{path}": data for path, data in metadata.items() if path != ROOT})
    storage.put(f"{SEALED}/{ROOT}", metadata[ROOT])
    # Another process that seals or unseals may have removed chunks before the root was written: copy them
    # again. Another seal does the same for its own store.
    _copy_chunks(contents, len(contents.shards), tidy=False)


def unseal_prefix(storage: Storage) -> None:
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

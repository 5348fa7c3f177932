"""A sealed store in an object store: server-side copies of the chunks, published by its root's zarr.json.

Nothing can be renamed there. So the root is what makes a store: without it `zarr.open` finds none, and
its consolidated metadata alone says how long the arrays are.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from datagen.schemas.fields import Field
from datagen.schemas.sealing.contents import Contents
from datagen.schemas.sealing.metadata import ROOT, SEALED, sealed_root
from datagen.schemas.shard_files import TABLES
from datagen.schemas.storage import Storage


def seal_prefix(contents: Contents, metadata: Mapping[str, bytes]) -> None:
    """Make data.zarr below the place from the chunks of the contents and the metadata, root last.

    A store whose shards are the first of the new one's stays open meanwhile: chunks are added to it, and
    the root switches over. Any other is removed first, from its root on. A kill leaves the old store, the
    new one, or none; what lies there without a root counts as nothing.
    """
    place = contents.place
    old = sealed_root(place)
    kept = contents.digests.index(old.rows_sha256) if old and old.rows_sha256 in contents.digests else 0
    if not kept:
        unseal_prefix(place)
    _copy_chunks(contents, kept, tidy=True)
    place.put_many({f"{SEALED}/{path}": data for path, data in metadata.items() if path != ROOT})
    place.put(f"{SEALED}/{ROOT}", metadata[ROOT])
    # Whoever seals or unseals at the same time may have removed chunks of these shards before the root
    # stood. What he published since is his own to look after.
    _copy_chunks(contents, len(contents.shards), tidy=False)


def unseal_prefix(place: Storage) -> None:
    """Remove data.zarr below the place: its root, then the arrays' metadata, so that nothing opens while
    chunks go."""
    place.delete([f"{SEALED}/{ROOT}"])
    place.delete([f.key for f in place.list(SEALED) if f.key.endswith(f"/{ROOT}")])
    place.delete(f.key for f in place.list(SEALED))


def _copy_chunks(contents: Contents, kept: int, tidy: bool) -> None:
    """Copy all chunks but those that the first `kept` shards left there; `tidy` removes what is no chunk.

    What a killed seal left beyond them may be of other shards, and is copied anew.
    """
    for table in TABLES:
        for field in contents.schema.table(table):
            odd = _copy_array(contents, field, kept)
            if tidy:
                contents.place.delete(odd)


def _copy_array(contents: Contents, field: Field, kept: int) -> list[str]:
    """Copy an array's chunks; keys of what is none of them."""
    place, folder = contents.place, f"{SEALED}/{field.name}"
    there = {f.key.removeprefix(f"{folder}/") for f in place.list(folder)} - {ROOT}

    def missing() -> Iterator[tuple[str, str]]:
        for position, source, name in contents.chunks(field):
            if not (name in there and position < kept):
                yield source, f"{folder}/{name}"
            there.discard(name)

    place.adopt_many(place, missing())
    return [f"{folder}/{name}" for name in sorted(there)]

"""Write one array of a sealed store: files of many chunks and their index, by Zarr's sharding codec."""

from __future__ import annotations

from collections.abc import Iterator

import google_crc32c
import numpy as np

from datagen.schemas.fields import Field
from datagen.schemas.shard_files import encode_chunk, fill_value
from datagen.schemas.stored_arrays import Array, StoredArray, chunk_path

_NO_CHUNK = 2**64 - 1  # offset and size of a chunk beyond the array's end


class ArrayFiles:
    """Collects an array's chunks and yields (path, bytes) of each full file. Holds at most one file."""

    def __init__(self, array: StoredArray, field: Field) -> None:
        self._array, self._field = array, field
        self._chunks: list[bytes] = []
        self._pending: list[Array] = []  # rows that do not fill a chunk yet
        self._files = 0

    @property
    def is_aligned(self) -> bool:
        """Whether the next row begins a chunk."""
        return not self._pending

    def add_chunk(self, chunk: bytes) -> Iterator[tuple[str, bytes]]:
        """Add an encoded chunk, at the beginning of a chunk."""
        self._chunks.append(chunk)
        if len(self._chunks) == self._array.per_file:
            yield self._file()

    def add_rows(self, values: Array) -> Iterator[tuple[str, bytes]]:
        """Add rows, which are encoded as soon as they fill a chunk."""
        rows = np.concatenate([*self._pending, values])
        size = self._array.chunk_rows
        for first in range(0, len(rows) - size + 1, size):
            yield from self.add_chunk(encode_chunk(self._field, rows[first : first + size]))
        rest = rows[len(rows) // size * size :]
        self._pending = [rest.copy()] if len(rest) else []

    def close(self) -> Iterator[tuple[str, bytes]]:
        """Fill the last chunk, and yield the last file."""
        if self._pending:
            missing = self._array.chunk_rows - len(self._pending[0])
            shape = (missing, *self._array.shape[1:])
            filler = np.full(shape, fill_value(self._field), self._pending[0].dtype)
            yield from self.add_rows(filler)
        if self._chunks:
            yield self._file()

    def _file(self) -> tuple[str, bytes]:
        index = np.full((self._array.per_file, 2), _NO_CHUNK, "<u8")
        sizes = np.array([len(chunk) for chunk in self._chunks], np.uint64)
        index[: len(sizes), 0] = np.cumsum(sizes) - sizes
        index[: len(sizes), 1] = sizes
        packed = index.tobytes()
        data = b"".join([*self._chunks, packed, google_crc32c.value(packed).to_bytes(4, "little")])
        path = chunk_path(self._array, self._files)
        self._chunks, self._files = [], self._files + 1
        return path, data

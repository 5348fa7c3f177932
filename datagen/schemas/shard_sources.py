"""Where the chunks of shards lie: in the object of a committed shard, or in the files of a sealed store."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import google_crc32c
import numpy as np
import numpy.typing as npt

from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.run_records import FileEntry
from datagen.schemas.safe_files import DAMAGED_ZIP
from datagen.schemas.storage import Storage
from datagen.schemas.stored_arrays import (
    DAMAGE_FIX,
    MAX_DECODED_BYTES,
    MAX_META_BYTES,
    StoredArray,
    chunk_path,
    parse_metadata,
)

Wanted = Sequence[tuple[StoredArray, int]]  # chunks, each as its array and its index there


class Source(Protocol):
    """Where arrays lie: `chunks` are (address, bytes), in the order of the wanted ones."""

    @property
    def url(self) -> str: ...
    def metadata(self, names: Sequence[str]) -> dict[str, StoredArray]: ...
    def chunks(self, wanted: Wanted) -> Iterator[tuple[str, bytes]]: ...


@dataclass(eq=False)
class ShardObject:
    """The committed object of one shard. Its sha256 is checked when it is first read."""

    run: Run
    entry: FileEntry  # of the commit
    is_checked: bool = False

    @property
    def url(self) -> str:
        return f"{self.run.storage.url}/shards/{self.entry.path}"

    def metadata(self, names: Sequence[str]) -> dict[str, StoredArray]:
        files = self._open()
        return {
            name: parse_metadata(f"{self.url}/{name}/zarr.json", name, files.get(f"{name}/zarr.json"))
            for name in names
        }

    def chunks(self, wanted: Wanted) -> Iterator[tuple[str, bytes]]:
        files = self._open()
        for path in (chunk_path(array, index) for array, index in wanted):
            yield f"{self.url}/{path}", files.get(path)

    def _open(self) -> ZipFiles:
        data = self.run.read_rows(self.entry, check=not self.is_checked)
        self.is_checked = True
        return ZipFiles(self.url, data)


# OverflowError: an offset that no file has.
_DAMAGED = (*DAMAGED_ZIP, OverflowError)


class ZipFiles:
    """The files in a shard's object. InputError where it is not such a zip, or lacks a file."""

    def __init__(self, place: str, data: bytes) -> None:
        self._place = place
        try:
            self._zip = zipfile.ZipFile(io.BytesIO(data))
        except _DAMAGED as e:
            raise InputError(place, "", f"is not the object of a shard ({e})", DAMAGE_FIX) from e
        self.paths = [entry.filename for entry in self._zip.infolist()]

    def get(self, path: str) -> bytes:
        try:
            entry = self._zip.getinfo(path)
            if entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1:
                raise zipfile.BadZipFile("compressed or encrypted")
            return self._zip.read(entry)
        except KeyError as e:
            raise InputError(f"{self._place}/{path}", "", "no such file", DAMAGE_FIX) from e
        except _DAMAGED as e:
            raise InputError(f"{self._place}/{path}", "", f"is damaged ({e})", DAMAGE_FIX) from e


@dataclass(eq=False)
class StoreFiles:
    """A sealed store, in whose files the chunks of many shards lie behind an index."""

    storage: Storage
    _indices: dict[str, npt.NDArray[np.uint64]] = field(default_factory=dict)

    @property
    def url(self) -> str:
        return self.storage.url

    def metadata(self, names: Sequence[str]) -> dict[str, StoredArray]:
        found: dict[str, StoredArray] = {}
        keys = [f"{name}/zarr.json" for name in names]
        for name, (key, data) in zip(names, self.storage.get_many(keys, MAX_META_BYTES), strict=True):
            if data is None:
                raise InputError(f"{self.url}/{key}", name, "no such file", DAMAGE_FIX)
            found[name] = parse_metadata(f"{self.url}/{key}", name, data)
        return found

    def chunks(self, wanted: Wanted) -> Iterator[tuple[str, bytes]]:
        return self.storage.concurrent_map(lambda one: self._chunk(*one), wanted)

    def _chunk(self, array: StoredArray, index: int) -> tuple[str, bytes]:
        file, inner = divmod(index, array.per_file) if array.per_file else (index, 0)
        key = chunk_path(array, file)
        place = f"{self.url}/{key}"
        if not array.per_file:
            data = self.storage.get(key, MAX_DECODED_BYTES)
        else:
            start, size = (int(number) for number in self._index(key, array)[inner])
            if start + size > 2**50 or not 0 < size <= MAX_DECODED_BYTES:
                raise InputError(place, array.name, "its index names a chunk that cannot be", DAMAGE_FIX)
            data = self.storage.get_range(key, start, size)
        if data is None:
            raise InputError(place, array.name, "no such file", DAMAGE_FIX)
        return place, data

    def _index(self, key: str, array: StoredArray) -> npt.NDArray[np.uint64]:
        if key not in self._indices:
            size = 16 * array.per_file + 4
            data = self.storage.get_range(key, -size, size)
            if data is None or len(data) != size or google_crc32c.value(data[:-4]) != _crc(data):
                raise InputError(
                    f"{self.url}/{key}", array.name, "its index is missing or damaged", DAMAGE_FIX
                )
            self._indices[key] = np.frombuffer(data[:-4], "<u8").reshape(-1, 2)
        return self._indices[key]


def _crc(data: bytes) -> int:
    return int.from_bytes(data[-4:], "little")

"""Golden stores as archives: every file's bytes once, by their digest, and an index of names."""

from __future__ import annotations

import hashlib
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import zarr

INDEX = "index.json"
# A fixed time in every entry: equal files give equal archives.
_TIME = (2020, 1, 1, 0, 0, 0)


def pack(folder: Path, archive: Path) -> None:
    """Write all files below a folder; linked and equal ones take no more room."""
    index: dict[str, str] = {}
    blobs: dict[str, bytes] = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        data = path.read_bytes()
        digest = hashlib.sha256(data).hexdigest()
        index[str(path.relative_to(folder))] = digest
        blobs[digest] = data
    with zipfile.ZipFile(archive, "x", zipfile.ZIP_DEFLATED, compresslevel=9) as out:
        for name, data in {INDEX: json.dumps(index).encode(), **dict(sorted(blobs.items()))}.items():
            out.writestr(
                zipfile.ZipInfo(name[:16] if name != INDEX else name, _TIME), data, zipfile.ZIP_DEFLATED
            )


def unpack(archive: Path, folder: Path) -> None:
    """Write the files again, each with the bytes that its digest says."""
    with zipfile.ZipFile(archive) as stored:
        for name, digest in json.loads(stored.read(INDEX)).items():
            data = stored.read(digest[:16])
            assert hashlib.sha256(data).hexdigest() == digest, name
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)


def digests_of(store: Path) -> dict[str, str]:
    """sha256 of every array of a sealed store with its type and shape, read by zarr alone."""
    group = zarr.open_group(store, mode="r")
    return {name: digest_of(np.asarray(array[...])) for name, array in group.arrays()}


def digest_of(values: np.ndarray[Any, Any]) -> str:
    """sha256 of an array's type, shape and values."""
    if values.dtype.kind in "OTU":
        plain = json.dumps(values.tolist()).encode()
        kind = "string"
    else:
        plain = np.ascontiguousarray(values, values.dtype.newbyteorder("<")).tobytes()
        kind = values.dtype.name
    return hashlib.sha256(f"{kind} {list(values.shape)} ".encode() + plain).hexdigest()

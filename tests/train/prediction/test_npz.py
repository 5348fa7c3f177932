"""Archives of arrays that are damaged or made to do harm: one line each, whatever zipfile or numpy raise."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from datagen.schemas.errors import InputError
from datagen.train.prediction.files import read_arrays

DEPTH = np.arange(6, dtype=np.float32).reshape(2, 3)


def packed(content: bytes, method: int = zipfile.ZIP_STORED) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        archive.writestr("depth.npy", content)
    return out.getvalue()


def saved(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def refused(path: Path, data: bytes) -> bool:
    path.write_bytes(data)
    try:
        read_arrays(path)
    except InputError as error:
        assert error.place == str(path) and "\n" not in str(error)
        return True
    return False


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_changed_bytes_truncation_and_foreign_compression_give_one_line(tmp_path: Path, method: int):
    good = packed(saved(DEPTH), method)
    path = tmp_path / "a.npz"
    assert not refused(path, good)
    for foreign in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):  # which numpy never writes
        assert refused(path, packed(saved(DEPTH), foreign))
    for at in range(len(good)):
        assert refused(path, good[:at])
        for bit in (0x01, 0x10, 0x80):
            refused(path, good[:at] + bytes([good[at] ^ bit]) + good[at + 1 :])


@pytest.mark.parametrize(
    ("descr", "shape", "size"),
    [
        ("'<f4'", "(2, 3", 24),
        ("'''<f4'", "(2, 3)", 24),
        ("'<f4'", "(-2, -3)", 24),
        ("'<f4'", "(2, 3), 8: 1", 24),
        ("'<f4', []: 8", "(2, 3)", 24),
        ("('<f4',)", "(2, 3)", 24),
        ("'<f4'", "(0, 99999999999999999999)", 0),
        ("'|u1'", "(True,)", 1),
        ("(" * 9000, "(2, 3)", 24),
    ],
)
def test_invalid_array_headers_are_refused(tmp_path: Path, descr: str, shape: str, size: int):
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}\n".encode()
    start = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text
    assert refused(tmp_path / "a.npz", packed(start + bytes(size)))

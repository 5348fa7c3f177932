"""Read frames from untrusted .npz archives: only known arrays of numbers, of bounded size."""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path

import numpy as np

from datagen.schemas.archives import DAMAGED_ARRAY, DAMAGED_ZIP, open_member
from datagen.schemas.errors import InputError
from datagen.schemas.untrusted_files import read_regular
from datagen.train.inputs import Array
from datagen.train.prediction.files import FILE_FIX, MAX_FILE_BYTES, MAX_PIXELS

NAMES = ("rgb", "depth", "intrinsics", "mask", "T_world_camera")
_MAX_ARRAY_BYTES = 4 * MAX_PIXELS
_MAX_RECORDS = 10_000
_FIX = (
    "Write it with numpy.savez: depth, rgb, intrinsics (fx, fy, cx, cy), and if you like mask, T_world_camera"
)


def read_arrays(path: Path) -> dict[str, Array]:
    """Those of `NAMES` that the archive holds. InputError for objects, bombs and what is no archive."""
    data = read_regular(path, MAX_FILE_BYTES, FILE_FIX)
    found: dict[str, Array] = {}
    try:
        # Every record of the zip's directory begins with these bytes; counted before a list is made of them.
        if data.count(b"PK\1\2") > _MAX_RECORDS:
            raise ValueError("too many records")
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            for name in NAMES:
                if (info := archive.NameToInfo.get(f"{name}.npy")) is not None:
                    with open_member(archive, info) as member:
                        unpacked = member.read(_MAX_ARRAY_BYTES + 1)
                    found[name] = _array(path, name, unpacked)
    except InputError:
        raise
    except DAMAGED_ZIP as error:
        raise InputError(path, "", f"is not a .npz archive ({type(error).__name__})", _FIX) from None
    if not found:
        raise InputError(path, "", f"has none of {', '.join(NAMES)}", _FIX)
    return found


def _array(path: Path, name: str, data: bytes) -> Array:
    """One array of numbers; its header is held against its bytes before anything of its size is made."""
    if len(data) > _MAX_ARRAY_BYTES:
        raise InputError(path, name, f"unpacks to more than {_MAX_ARRAY_BYTES:,} bytes", _FIX)
    file = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(file)
        reader = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        shape, _, dtype = reader[version](file)
    except DAMAGED_ARRAY as error:
        raise InputError(path, name, f"is not an array ({type(error).__name__})", _FIX) from None
    if dtype.hasobject or dtype.kind not in "buif":
        raise InputError(path, name, f"holds {dtype}, not numbers", _FIX)
    size = math.prod(shape) * dtype.itemsize
    sound = all(type(length) is int and 0 <= length <= len(data) for length in shape)
    if not sound or size != len(data) - file.tell():
        raise InputError(path, name, f"has {len(data) - file.tell():,} of {size:,} bytes", _FIX)
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)

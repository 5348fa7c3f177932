"""Read the untrusted files of a frame: images, small JSON documents, .npz archives of bounded size."""

from __future__ import annotations

import io
import math
import re
import zipfile
from pathlib import Path

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import DAMAGED_ARRAY, DAMAGED_ZIP, open_member, read_regular
from datagen.train.inputs import F32, F64, U8, Array, Bools
from datagen.workers.geometry.transforms import is_pose
from datagen.workers.image_file import FILE_FIX, MAX_FILE_BYTES, MAX_PIXELS, opened
from datagen.workers.json_document import parse_json

_MAX_JSON_BYTES = 2**20
# The largest entry of R R^T - I: poses are often text of four or five digits.
_POSE_ROUNDING = 1e-3
_EXTENT_M = 1000.0
# No depth camera measures farther; larger values are saturated.
MAX_DEPTH_M = 20.0
# Medians of depth images of rooms (m), and steps a metre that cameras and data sets have.
_MEDIAN_M, STEPS = (0.05, 15.0), (1, 1000, 4000, 5000, 10_000)
NAMES = ("rgb", "depth", "intrinsics", "mask", "T_world_camera")
_MAX_ARRAY_BYTES = 4 * MAX_PIXELS
_MAX_RECORDS = 10_000
_NPZ_FIX = (
    "Write it with numpy.savez: depth, rgb, intrinsics (fx, fy, cx, cy), and if you like mask, T_world_camera"
)


def read_rgb(path: Path) -> U8:
    """A colour picture (H, W, 3): PNG, JPEG, TIFF or PPM."""
    return np.asarray(opened(path, ("PNG", "JPEG", "TIFF", "PPM"), "RGB"), np.uint8)


def read_mask(path: Path) -> Bools:
    """Mask (H, W) of the pixels of a PNG that are not black; an alpha channel is ignored."""
    pixels = np.asarray(opened(path, ("PNG",), "RGB"))
    return np.asarray(pixels.any(axis=2), np.bool_)


def read_depth(path: Path) -> Array:
    """Depth (H, W) as it is stored: uint16 or float of a PNG, TIFF, PGM, .npy, or the array of an .npz."""
    data = read_regular(path, MAX_FILE_BYTES, FILE_FIX)
    if data.startswith(b"PK"):
        found = read_arrays(path, ("depth", "arr_0"))
        return checked_depth(next(iter(found.values())), path)
    if data.startswith(b"\x93NUMPY"):
        return checked_depth(_array(path, "depth", data), path)
    image = opened(path, ("PNG", "TIFF", "PPM"), None)
    if not image.mode.startswith("I") and image.mode != "F":
        fix = "Save depth as a 16-bit grey PNG, TIFF or PGM, or as floats in metres (TIFF, .npy)"
        raise InputError(path, "", f"is not a 16-bit depth image (its mode is {image.mode})", fix)
    values = np.asarray(image)
    if data[:2] in (b"P2", b"P5") and image.mode == "I":
        # Pillow scales the values of a PGM from its largest one to 16 bits.
        words = re.sub(rb"#[^\n]*", b"", data[:10_000]).split(maxsplit=4)
        if len(words) < 4:
            raise InputError(path, "", "has a header of more than 10,000 bytes", "Leave out its comments")
        values = np.rint(values * (int(words[3]) / 65535))
    return checked_depth(values if image.mode == "F" else np.clip(values, 0, 65535).astype(np.uint16), path)


def checked_depth(depth: Array, path: Path) -> Array:
    """The depth, or an InputError for another shape than (H, W) or another type than uint16 and float."""
    if depth.ndim != 2 or depth.size > MAX_PIXELS or min(depth.shape) < 2:
        raise InputError(path, "depth", f"has shape {depth.shape}", "Give depth as (H, W)")
    if depth.dtype.kind != "f" and (depth.dtype.kind, depth.dtype.itemsize) != ("u", 2):
        fix = "Give uint16 in steps of --depth-scale, or float in metres"
        raise InputError(path, "depth", f"has type {depth.dtype}", fix)
    return depth


def scaled_depth(depth: Array, scale: float | None, place: str | Path) -> tuple[F32, float, tuple[str, ...]]:
    """(depth (H, W) in metres, 0 where nothing was measured; metres a step; notes).

    `scale` is in metres a step below 1, else in steps a metre. Without it whole numbers are millimetres, and
    floats metres, or millimetres where their median is above 50. InputError for a median that no camera of
    rooms has: it names the scales that give one.
    """
    known = depth[np.isfinite(depth) & (depth > 0)].astype(np.float64)
    median, whole = float(np.median(known)) if len(known) else 0.0, depth.dtype.kind != "f"
    step_m = (0.001 if whole or median > 50 else 1.0) if scale is None else min(scale, 1 / scale)
    why = "16-bit numbers" if whole else f"floats with a median of {median:.4g}"
    why, metres = why if scale is None else f"--depth-scale {scale:g}", median * step_m
    if len(known) and not _MEDIAN_M[0] <= metres <= _MEDIAN_M[1]:
        likely = [f"{n} (median {median / n:.2f} m)" for n in STEPS if 0.3 <= median / n <= 6]
        fix = f"Give --depth-scale {' or '.join(likely)}" if likely else "Check the camera's depth stream"
        problem = f"has a median of {metres:.4g} m at {step_m:g} m a step ({why})"
        raise InputError(place, "depth", problem, fix)
    note = f"depth was taken to be in steps of {step_m:g} m ({why}): median {metres:.2f} m"
    with np.errstate(over="ignore", invalid="ignore"):
        depth_m = valid_depth((depth.astype(np.float64) * step_m).astype(np.float32))
    return depth_m, step_m, () if scale is not None or whole or step_m == 1 else (note,)


def valid_depth(depth_m: F32) -> F32:
    """Depth (H, W) with 0 for values that are not finite, not positive or beyond `MAX_DEPTH_M`."""
    good = np.isfinite(depth_m) & (depth_m > 0) & (depth_m <= MAX_DEPTH_M)
    return np.where(good, depth_m, np.float32(0)).astype(np.float32)


def read_pose(path: Path) -> F64:
    """`T_world_camera` (4, 4): the value of that key, or the whole document; rows of four numbers."""
    data = read_regular(path, _MAX_JSON_BYTES, "Name a readable JSON file of at most 1 MiB")
    node = parse_json(data, str(path))
    if isinstance(node.value, dict):
        node = node.get("T_world_camera")
    rows = [[cell.number(-1e9, 1e9) for cell in row.items(4)] for row in node.items(4)]
    if [len(row) for row in rows] != [4, 4, 4, 4]:
        raise node.error("not four rows of four numbers", "Write a 4x4 matrix, row by row.")
    return checked_pose(np.array(rows), str(path))


def checked_pose(T: F64, place: str) -> F64:
    """The pose with its rotation made exact. InputError for NaN and for a part that is no rotation."""
    fix = "Give T_world_camera as 4x4: a rotation, a position in metres, and the row 0 0 0 1"
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(place, "T_world_camera", "is not 4x4 finite numbers", fix)
    if not is_pose(T, _POSE_ROUNDING):
        raise InputError(place, "T_world_camera", "has an upper left 3x3 part that is not a rotation", fix)
    if np.abs(T[:3, 3]).max() > _EXTENT_M:
        raise InputError(place, "T_world_camera", f"is farther than {_EXTENT_M:g} m from the origin", fix)
    # The nearest rotation (Schoenemann 1966), so that rounded text does not stretch the cloud.
    u, _, vt = np.linalg.svd(T[:3, :3])
    exact = T.astype(np.float64)
    exact[:3, :3] = u @ vt
    return exact


def read_arrays(path: Path, names: tuple[str, ...] = NAMES) -> dict[str, Array]:
    """Those of `names` that the archive holds. InputError for objects, zip bombs and other files."""
    data = read_regular(path, MAX_FILE_BYTES, FILE_FIX)
    found: dict[str, Array] = {}
    try:
        # Every record of the zip's directory begins with these bytes; counted before a list is made of them.
        if data.count(b"PK\1\2") > _MAX_RECORDS:
            raise ValueError("too many records")
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            for name in names:
                if (info := archive.NameToInfo.get(f"{name}.npy")) is not None:
                    with open_member(archive, info) as member:
                        unpacked = member.read(_MAX_ARRAY_BYTES + 1)
                    found[name] = _array(path, name, unpacked)
    except InputError:
        raise
    except DAMAGED_ZIP as error:
        raise InputError(path, "", f"is not a .npz archive ({type(error).__name__})", _NPZ_FIX) from None
    if not found:
        raise InputError(path, "", f"has none of {', '.join(names)}", _NPZ_FIX)
    return found


def _array(path: Path, name: str, data: bytes) -> Array:
    """One array of numbers; its header is compared with its bytes before memory is allocated."""
    if len(data) > _MAX_ARRAY_BYTES:
        raise InputError(path, name, f"unpacks to more than {_MAX_ARRAY_BYTES:,} bytes", _NPZ_FIX)
    file = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(file)
        reader = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        shape, _, dtype = reader[version](file)
    except DAMAGED_ARRAY as error:
        raise InputError(path, name, f"is not an array ({type(error).__name__})", _NPZ_FIX) from None
    if dtype.hasobject or dtype.kind not in "buif":
        raise InputError(path, name, f"holds {dtype}, not numbers", _NPZ_FIX)
    size = math.prod(shape) * dtype.itemsize
    sound = all(type(length) is int and 0 <= length <= len(data) for length in shape)
    if not sound or size != len(data) - file.tell():
        raise InputError(path, name, f"has {len(data) - file.tell():,} of {size:,} bytes", _NPZ_FIX)
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)

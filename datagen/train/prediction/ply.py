"""Read point clouds from untrusted PLY files, ASCII or binary (Turk 1994): only vertices."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular
from datagen.train.inputs import F32, F64, U8, Bools
from datagen.workers.image_file import FILE_FIX, MAX_FILE_BYTES

MAX_POINTS = 20_000_000
_MAX_ASCII_POINTS = 2_000_000  # parsed as text they take a hundred times their memory
_MAX_HEADER_BYTES = 1 << 16
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_FIX = "Save the cloud again as PLY or PCD, with x, y and z in metres"


@dataclass(frozen=True, eq=False)
class PointFile:
    """Points in the order of the file; grey without colours, `on_target` None without targets."""

    points_m: F32  # (N, 3)
    rgb: U8  # (N, 3)
    on_target: Bools | None  # (N,)


def read_ply(path: Path) -> PointFile:
    """The finite vertices of a file: x, y, z, and optionally red, green, blue, and target."""
    data = read_regular(path, MAX_FILE_BYTES, FILE_FIX)
    form, count, properties, start = _header(path, data)
    if not count:
        raise InputError(path, "element vertex", "has no vertices", _FIX)
    names = [name for name, _ in properties]
    missing = [axis for axis in "xyz" if axis not in names]
    if missing or len(set(names)) < len(names):
        what = f"no property {missing[0]}" if missing else "a property named twice"
        raise InputError(path, "element vertex", what, _FIX)
    body = memoryview(data)[start:]
    return cloud_of(path, columns_of(path, body, count, properties, _FORMATS[form]))


def cloud_of(path: Path, columns: dict[str, npt.NDArray[np.generic]]) -> PointFile:
    """The finite points of columns x, y, z, and optionally red, green, blue, and target."""
    with np.errstate(over="ignore"):  # doubles beyond float32 are infinite, and are left out below
        points = np.stack([columns[axis].astype(np.float32) for axis in "xyz"], axis=1)
    finite = np.isfinite(points).all(axis=1) & (np.abs(points) < 1e4).all(axis=1)
    colours = np.full(points.shape, 150, np.uint8)
    if {"red", "green", "blue"} <= columns.keys():
        colours = np.stack([_colour(columns[c]) for c in ("red", "green", "blue")], axis=1)
    on_target = columns["target"] != 0 if "target" in columns else None
    if not finite.any():
        raise InputError(path, "points", "none is finite", _FIX)
    return PointFile(points[finite], colours[finite], None if on_target is None else on_target[finite])


def _header(path: Path, data: bytes) -> tuple[str, int, list[tuple[str, str]], int]:
    """(format, vertices, their properties, where the body starts)."""
    end = data.find(b"end_header", 0, _MAX_HEADER_BYTES)
    if not data.startswith(b"ply") or end < 0 or (line_end := data.find(b"\n", end)) < 0:
        raise InputError(path, "header", "is not that of a PLY file", _FIX)
    lines = data[:end].decode("ascii", errors="replace").splitlines()
    form, count, properties, element = "", -1, list[tuple[str, str]](), ""
    for number, line in enumerate(lines[1:], start=2):
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        place = f"header, line {number}"
        match words:
            case ["format", kind, *_] if kind in _FORMATS:
                form = kind
            case ["element", "vertex", n] if not element:
                element, count = "vertex", count_of(path, place, n)
            case ["element", name, *_]:
                if not element:
                    raise InputError(path, place, f"element {name[:40]} comes before the vertices", _FIX)
                element = name
            case ["property", kind, name] if element == "vertex" and kind in _TYPES and len(properties) < 64:
                properties.append((name, _TYPES[kind]))
            case ["property", *_] if element and element != "vertex":
                pass
            case _:
                raise InputError(path, place, f"is not valid: {line[:60]}", _FIX)
    if not form or count < 0:
        raise InputError(path, "header", "has no format, or no vertices", _FIX)
    return form, count, properties, line_end + 1


def count_of(path: Path, place: str, text: str) -> int:
    """The number of vertices that a header has. InputError for other text and for too many."""
    if not (text.isascii() and text.isdigit()) or len(text) > 18:
        raise InputError(path, place, f"{text[:40]} is not a number of vertices", _FIX)
    if int(text) > MAX_POINTS:
        raise InputError(path, place, f"has {int(text):,} vertices", f"Give at most {MAX_POINTS:,}")
    return int(text)


def columns_of(
    path: Path, body: memoryview, count: int, properties: list[tuple[str, str]], order: str
) -> dict[str, npt.NDArray[np.generic]]:
    """Columns (count,) of the vertices; as text where `order` is empty."""
    if order:
        row = np.dtype([(name, order + kind) for name, kind in properties])
        if len(body) < count * row.itemsize:
            raise _short(path, count, len(body) // row.itemsize)
        vertices = np.frombuffer(body, row, count)
        return {name: vertices[name] for name, _ in properties}
    if count > _MAX_ASCII_POINTS:
        raise InputError(path, "format", f"has {count:,} vertices as text", "Save it in a binary format")
    # A number is a character and a space at least: nothing is allocated for vertices that cannot exist.
    if len(body) < count * (2 * len(properties) - 1):
        raise _short(path, count, len(body) // (2 * len(properties)))
    lines = bytes(body).split(b"\n", count)[:count]
    try:
        table = np.array([line.split() for line in lines], "S32").astype(np.float64)
    except ValueError:
        raise InputError(path, "vertices", "are not rows of numbers of equal length", _FIX) from None
    if table.shape != (count, len(properties)):
        raise _short(path, count, len(table))
    return {name: _as_declared(table[:, k], kind) for k, (name, kind) in enumerate(properties)}


def _as_declared(values: F64, kind: str) -> npt.NDArray[np.generic]:
    """Values as bytes where declared so, which decides whether a colour of 1 is black or full."""
    return np.clip(np.nan_to_num(values), 0, 255).astype(np.uint8) if kind == "u1" else values


def _short(path: Path, count: int, found: int) -> InputError:
    return InputError(path, "element vertex", f"has {found:,} of {count:,} vertices", _FIX)


def _colour(values: npt.NDArray[np.generic]) -> U8:
    """Colours as bytes; values up to 1, which some programs write, are fractions of full colour."""
    if values.dtype == np.uint8:
        return values.astype(np.uint8)
    numbers = np.nan_to_num(values.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    scale = 255.0 if numbers.size and numbers.max() <= 1.0 else 1.0
    return np.clip(numbers * scale, 0, 255).astype(np.uint8)

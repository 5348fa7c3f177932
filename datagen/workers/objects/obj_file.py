"""Wavefront OBJ read into arrays in bounded memory, with errors that name the line."""

from __future__ import annotations

import itertools
import math
import re
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.schemas.errors import InputError, printable
from datagen.schemas.safe_files import open_regular
from datagen.workers.foreign_files import START_BYTES, refuse_other_kind
from datagen.workers.geometry.mesh import F64

I64 = npt.NDArray[np.int64]

MAX_FILE_BYTES = 512 * 2**20
MAX_FACES = 2_000_000
MAX_VERTICES = 4_000_000
MAX_LINES = 16_000_000  # faces, vertices, and their texture coordinates and normals
MAX_NAMES = 100_000  # groups, or materials
MAX_LINE_BYTES = 2**20
_BLOCK_BYTES = 2**16
_INTEGER = re.compile(rb"-?\d+")
_CORNERS = re.compile(rb"(?:0 )*0|(?:0/0 )*0/0|(?:0//0 )*0//0|(?:0/0/0 )*0/0/0")


@dataclass(frozen=True, eq=False)
class ObjMesh:
    """The triangles of an OBJ file. Polygons are cut into fans; indices start at 0."""

    vertices: F64  # (V, 3), the file's units
    uv: F64  # (T, 2), (0, 0) at the image's lower left corner
    faces: I64  # (F, 3) into vertices
    uv_faces: I64  # (F, 3) into uv, -1 where a corner has none
    group_starts: I64  # (G,) index of the first face of each `o` (or else `g`) group
    material_library: str = ""
    materials: tuple[str, ...] = ()  # those of its faces, by first use
    material_starts: tuple[
        tuple[int, str], ...
    ] = ()  # index of the first face that has it, in the file's order

    def group_faces(self) -> list[I64]:
        """The faces of each named group that has any; all faces as one group where none is named."""
        cuts = np.unique(np.concatenate([[0], self.group_starts, [len(self.faces)]]))
        return [self.faces[a:b] for a, b in itertools.pairwise(cuts) if b > a]


def read_obj(path: Path) -> ObjMesh:
    """Reads vertices, texture coordinates, faces and groups; other statements are skipped.

    Works block by block and stops at the first limit passed, so that memory stays near the size
    of the arrays. Raises InputError naming the file and the line or the index at fault: missing
    or oversized file, no faces, too many faces, unreadable numbers, NaN, index out of range.
    """
    vertices, uv, faces, uv_faces = array("d"), array("d"), array("q"), array("q")
    starts: dict[bytes, list[int]] = {b"o": [], b"g": []}
    library, materials = "", list[tuple[int, str]]()
    for number, kind, line in _pieces(path):
        keyword, rest = _split(line)
        try:
            if kind == "v":
                vertices.frombytes(numbers_of(line, kind).tobytes())
            elif kind == "vt":
                uv.frombytes(numbers_of(line, kind).tobytes())
            elif kind == "f":
                corners = numbers_of(line, kind)
                faces.frombytes(corners.tobytes())
                uv_faces.frombytes(bytes(corners.nbytes))
            elif kind == "f/":
                corners = numbers_of(line, kind).reshape(-1, 2)
                faces.frombytes(corners[:, 0].tobytes())
                uv_faces.frombytes(corners[:, 1].tobytes())
            elif keyword == b"v":
                vertices.extend(_numbers(rest, 3))
            elif keyword == b"vt":
                uv.extend(_numbers(rest, 2))
            elif keyword == b"f":
                v, t = _corners(rest, len(vertices) // 3, len(uv) // 2)
                for k in range(1, len(v) - 1):
                    faces.extend((v[0], v[k], v[k + 1]))
                    uv_faces.extend((t[0], t[k], t[k + 1]))
            elif keyword in starts:
                starts[keyword].append(len(faces) // 3)
                if len(starts[keyword]) > MAX_NAMES:
                    raise ValueError(f"more than {MAX_NAMES:,} groups")
            elif keyword == b"mtllib":
                library = library or _name(rest)
            elif keyword == b"usemtl":
                materials.append((len(faces) // 3, _name(rest)))
                if len(materials) > MAX_NAMES:
                    raise ValueError(f"more than {MAX_NAMES:,} materials")
        except ValueError as error:
            shown = printable(line[:60].decode("utf-8", "replace").strip())
            fix = "Export the mesh again as text OBJ"
            raise InputError(path, f"line {number}", f"{error}: {shown!r}", fix) from None
        if len(faces) > 3 * MAX_FACES or len(vertices) > 3 * MAX_VERTICES or len(uv) > 2 * MAX_VERTICES:
            problem = f"the mesh has more than {MAX_FACES:,} faces or {MAX_VERTICES:,} vertices"
            raise InputError(path, "", problem, "Simplify the mesh")
    if not faces:
        raise InputError(path, "", "the mesh has no faces", "Give an OBJ file with `v` and `f` lines")
    mesh = ObjMesh(
        np.array(vertices).reshape(-1, 3),
        np.array(uv).reshape(-1, 2),
        np.array(faces).reshape(-1, 3) - 1,
        np.array(uv_faces).reshape(-1, 3) - 1,
        np.array(starts[b"o"] or starts[b"g"], np.int64),
        library,
        _of_faces(materials, len(faces) // 3),
        tuple(materials),
    )
    _check_indices(path, mesh)
    return mesh


@dataclass(frozen=True)
class ObjHeader:
    """Names of the material library and the materials of an OBJ file."""

    material_library: str
    materials: tuple[str, ...]


def read_obj_header(path: Path) -> ObjHeader:
    """The mtllib and usemtl names of a file, without parsing its numbers. Raises InputError."""
    names: dict[bytes, dict[str, None]] = {b"mtllib": {}, b"usemtl": {}}
    for _, _, line in _pieces(path):
        keyword, name = _split(line)
        if keyword in names:
            names[keyword][_name(name)] = None
            if len(names[keyword]) > MAX_NAMES:
                raise InputError(path, "", f"the mesh has more than {MAX_NAMES:,} materials", "Join them")
    return ObjHeader(next(iter(names[b"mtllib"]), ""), tuple(names[b"usemtl"]))


def _pieces(path: Path) -> Iterator[tuple[int, str, bytes]]:
    """Yields (first line number from 1, kind, text) of each run of plain lines, or of one line of kind "".

    Lines may end with \\n, \\r\\n or \\r; one that ends with a backslash continues on the next.
    """
    number = 1
    for block in _blocks(path):
        start = 0
        while start < len(block):
            kind, end = plain_run(block, start)
            while not kind and block[start:end].endswith(b"\\\n") and end < len(block):
                if block[start:end].lstrip().startswith(b"#"):
                    break
                end = block.find(b"\n", end) + 1 or len(block)
            piece = block[start:end]
            lines = piece.count(b"\n") or 1
            if not kind and len(piece.rstrip(b"\n")) >= MAX_LINE_BYTES:
                raise InputError(path, f"line {number}", "the line is too long", "Give a text OBJ file")
            if number + lines - 1 > MAX_LINES:
                raise InputError(path, "", f"more than {MAX_LINES:,} lines", "Simplify the mesh")
            yield number, kind, piece if kind else piece.replace(b"\\\n", b" ")
            number, start = number + lines, end


def _blocks(path: Path) -> Iterator[bytes]:
    """The file in blocks of whole lines, each with \\n at its end, continued lines in one block."""
    with open_regular(path, MAX_FILE_BYTES, "Give a text OBJ file of a simplified mesh") as file:
        fix = "Export the mesh as text OBJ"
        refuse_other_kind(path, file.read(START_BYTES), "text", fix)
        file.seek(0)
        rest = b""
        while block := file.read(_BLOCK_BYTES):
            block = rest + block
            held = b"\r" if block.endswith(b"\r") else b""  # perhaps the first half of \r\n
            if b"\r" in block:
                block = block[: len(block) - len(held)].replace(b"\r\n", b"\n").replace(b"\r", b"\n")
            end = block.rfind(b"\n") + 1
            while block[:end].endswith(b"\\\n"):
                end = block.rfind(b"\n", 0, end - 1) + 1
            if end:
                yield block[:end]
            rest = block[end:] + held
            if len(rest) > MAX_LINE_BYTES:  # `_pieces` names its line
                break
        yield rest.replace(b"\r", b"\n")


def _split(line: bytes) -> tuple[bytes, bytes]:
    """The keyword of a line and what follows it."""
    words = line.split(None, 1)
    return (words[0] if words else b""), (words[1] if len(words) > 1 else b"")


def _name(text: bytes) -> str:
    return text.strip().decode("utf-8", "replace")


def _of_faces(materials: list[tuple[int, str]], n_faces: int) -> tuple[str, ...]:
    """The distinct materials, each given with the index of its first face, that any face has."""
    ends = [start for start, _ in materials[1:]] + [n_faces]
    return tuple(dict.fromkeys(name for (a, name), b in zip(materials, ends, strict=False) if b > a))


def _numbers(text: bytes, width: int) -> list[float]:
    """The first `width` numbers. Raises ValueError if there are fewer, or one is not finite."""
    words = text.split()[:width]
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) < width or b"_" in text:
        raise ValueError(f"{width} numbers are needed")
    if not all(map(math.isfinite, values)):
        raise ValueError("a number is not finite")
    return values


def _corners(text: bytes, n_vertices: int, n_uv: int) -> tuple[list[int], list[int]]:
    """Indices from 1 of a face's vertices, and of its texture coordinates (0: none).

    Negative ones count back from `n_vertices` and `n_uv`. Raises ValueError for an invalid face.
    """
    shape = _INTEGER.sub(b"0", b" ".join(text.split()))
    if not _CORNERS.fullmatch(shape) or shape.count(b" ") < 2:
        raise ValueError("a face needs 3 or more corners, all alike")
    indices = list(map(int, text.replace(b"/", b" ").split()))
    each = len(indices) // (shape.count(b" ") + 1)
    v = _from_first(indices[::each], n_vertices)
    return v, _from_first(indices[1::each], n_uv) if b"0/0" in shape else [0] * len(v)


def _from_first(indices: list[int], seen: int) -> list[int]:
    if min(indices) < 0:
        indices = [seen + 1 + index if index < 0 else index for index in indices]
    if not 0 < min(indices) <= max(indices) <= MAX_LINES:
        raise ValueError("an index is out of range")
    return indices


def _check_indices(path: Path, mesh: ObjMesh) -> None:
    for kind, index, count in (
        ("vertex", mesh.faces, len(mesh.vertices)),
        ("texture coordinate", mesh.uv_faces, len(mesh.uv)),
    ):
        high = index.max(axis=1)
        if high.max() >= count:
            raise InputError(
                path,
                f"face {int(np.argmax(high >= count)) + 1}",
                f"refers to {kind} {int(high.max()) + 1} of {count}",
                "Export the mesh again; it may be cut off",
            )


# Numbers too short to overflow, and indices that a face may have; the slow reader parses other lines.
_NUMBER = rb" -?\d{1,18}(?:\.\d{1,18})?(?:e[-+]?\d\d?)?"
_INDEX = rb" [1-9]\d{0,6}"
_PAIR = _INDEX + rb"/[1-9]\d{0,6}"
_KINDS = {
    "v": rb"v" + 3 * _NUMBER,
    "vt": rb"vt" + 2 * _NUMBER,
    "f": rb"f" + 3 * _INDEX,
    "f/": rb"f" + 3 * _PAIR,
}
# Not possessive (`++`), which Python 3.11 before 3.11.5 matches wrongly.
_RUN = re.compile(b"|".join(rb"((?:" + line + rb" ?\r?\n)+)" for line in _KINDS.values()))
_NAMES = tuple(_KINDS)


def plain_run(text: bytes, start: int) -> tuple[str, int]:
    """The kind and end of the plain lines that begin at `start`; kind "" and the line's end for others.

    Kinds are `v`, `vt`, `f` (triangles of vertices) and `f/` (of vertices and texture coordinates).
    """
    run = _RUN.match(text, start)
    if run is not None and run.lastindex is not None:
        return _NAMES[run.lastindex - 1], run.end()
    return "", text.find(b"\n", start) + 1 or len(text)


def numbers_of(run: bytes, kind: str) -> npt.NDArray[Any]:
    """All numbers of a run, in order: float64, or int64 from 1 for faces."""
    text = run.replace(kind[0].encode(), b"").replace(b"t", b"").replace(b"/", b" ")
    return np.fromstring(text, np.int64 if kind[0] == "f" else np.float64, sep=" ")

"""Wavefront OBJ read into arrays, with errors that name the line."""

from __future__ import annotations

import io
import itertools
import math
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

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
MAX_LINE_BYTES = 2**20
# What a face's corners have of vertex, texture coordinate and normal: 1/2, 1/2/3, and 1, 1//3.
_WITH_UV = {(True, True), (True, True, True)}
_SHAPES = {(True,), (True, False, True), *_WITH_UV}


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

    Raises InputError naming the file and the line or the index at fault: missing or oversized file, no faces,
    too many faces, unreadable numbers, NaN, index out of range.
    """
    vertices, uv, faces, uv_faces = array("d"), array("d"), array("q"), array("q")
    starts: dict[bytes, list[int]] = {b"o": [], b"g": []}
    library, materials = "", list[tuple[int, str]]()
    for number, keyword, rest in _lines(path):
        try:
            if keyword == b"v":
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
            elif keyword == b"mtllib":
                library = library or _name(rest)
            elif keyword == b"usemtl":
                materials.append((len(faces) // 3, _name(rest)))
        except ValueError as error:
            shown = printable((keyword + b" " + rest)[:60].decode("utf-8", "replace").strip())
            fix = "Export the mesh again as text OBJ"
            raise InputError(path, f"line {number}", f"{error}: {shown!r}", fix) from None
        if len(faces) > 3 * MAX_FACES or max(len(vertices), len(uv)) > 3 * MAX_VERTICES:
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


def read_obj_header(path: Path) -> tuple[str, tuple[str, ...]]:
    """The material library and the materials that a file names, without its numbers. Raises InputError."""
    names: dict[bytes, dict[str, None]] = {b"mtllib": {}, b"usemtl": {}}
    for _, keyword, rest in _lines(path):
        if keyword in names:
            names[keyword][_name(rest)] = None
    return next(iter(names[b"mtllib"]), ""), tuple(names[b"usemtl"])


def _lines(path: Path) -> Iterator[tuple[int, bytes, bytes]]:
    """The number from 1, the keyword and the rest of each line that has a keyword.

    Lines may end with \\n, \\r\\n or \\r; one that ends with a backslash continues on the next.
    """
    with open_regular(path, MAX_FILE_BYTES, "Give a text OBJ file of a simplified mesh") as file:
        refuse_other_kind(path, file.peek(START_BYTES)[:START_BYTES], "text", "Export the mesh as text OBJ")
        text = io.TextIOWrapper(file, "latin-1")  # a character for each byte
        number = 0
        while line := text.readline(MAX_LINE_BYTES):
            first = number = number + 1
            while line.endswith("\\\n") and len(line) < MAX_LINE_BYTES and line.lstrip()[0] != "#":
                line, number = f"{line[:-2]} {text.readline(MAX_LINE_BYTES)}", number + 1
            if len(line) >= MAX_LINE_BYTES:
                raise InputError(path, f"line {first}", "the line is too long", "Give a text OBJ file")
            if number > MAX_LINES:
                raise InputError(path, "", f"more than {MAX_LINES:,} lines", "Simplify the mesh")
            if words := line.encode("latin-1").split(None, 1):
                yield first, words[0], words[1] if len(words) > 1 else b""


def _name(text: bytes) -> str:
    return text.strip().decode("utf-8", "replace")


def _of_faces(materials: list[tuple[int, str]], n_faces: int) -> tuple[str, ...]:
    """The distinct materials, each given with the index of its first face, that any face has."""
    ends = [start for start, _ in materials[1:]] + [n_faces]
    return tuple(dict.fromkeys(name for (a, name), b in zip(materials, ends, strict=False) if b > a))


def _numbers(text: bytes, width: int) -> list[float]:
    """The first `width` numbers. Raises ValueError if there are fewer, or one is not finite."""
    try:
        values = list(map(float, text.split()[:width]))
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
    corners = [word.split(b"/") for word in text.split()]
    shapes = {tuple(map(bool, corner)) for corner in corners}
    if len(corners) < 3 or len(shapes) > 1 or not shapes <= _SHAPES or b"_" in text:
        raise ValueError("a face needs 3 or more corners, all alike")
    v = _from_first([int(corner[0]) for corner in corners], n_vertices)
    has_uv = shapes <= _WITH_UV
    return v, _from_first([int(corner[1]) for corner in corners], n_uv) if has_uv else [0] * len(v)


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

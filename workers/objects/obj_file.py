"""Wavefront OBJ read into arrays in bounded memory, with errors that name the line."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.schemas.errors import InputError
from datagen.schemas.untrusted_files import open_regular
from datagen.workers.geometry.mesh import F64

I64 = npt.NDArray[np.int64]

MAX_FILE_BYTES = 512 * 2**20
MAX_FACES = 2_000_000
MAX_VERTICES = 4_000_000
MAX_LINES = 16_000_000  # faces, vertices, and their texture coordinates and normals
MAX_NAMES = 100_000  # of groups, or of materials
BLOCK_BYTES = 2**20
_INTEGER = re.compile(rb"-?\d+")
_SPACES = re.compile(rb"[ \t]+")
_CORNERS = re.compile(rb"(?:0 )*0|(?:0/0 )*0/0|(?:0//0 )*0//0|(?:0/0/0 )*0/0/0")


@dataclass(frozen=True, eq=False)
class ObjMesh:
    """The triangles of an OBJ file. Polygons are cut into fans; indices start at 0."""

    vertices: F64  # (V, 3), the file's units
    uv: F64  # (T, 2), (0, 0) at the image's lower left corner
    faces: I64  # (F, 3) into vertices
    uv_faces: I64  # (F, 3) into uv, -1 where a corner has none
    group_starts: I64  # (G,) index of the first face of each `o` (or else `g`) group

    def group_faces(self) -> list[I64]:
        """The faces of each named group that has any; all faces as one group where none is named."""
        cuts = np.unique(np.concatenate([[0], self.group_starts, [len(self.faces)]]))
        return [self.faces[a:b] for a, b in pairwise(cuts) if b > a]


@dataclass
class _Growing:
    """What has been read so far."""

    vertices: list[F64]
    uv: list[F64]
    faces: list[I64]
    uv_faces: list[I64]
    starts: dict[bytes, list[int]]
    n_vertices: int = 0
    n_uv: int = 0
    n_faces: int = 0


def read_obj(path: Path) -> ObjMesh:
    """Reads vertices, texture coordinates, faces and groups; other statements are skipped.

    Works block by block and stops at the first limit passed, so that memory stays near the size
    of the arrays. Raises InputError naming the file and the line or the index at fault: missing
    or oversized file, no faces, too many faces, unreadable numbers, NaN, index out of range.
    """
    _refuse_at_a_glance(path)
    grown = _Growing([], [], [], [], {b"o": [], b"g": []})
    for first_line, lines in _blocks(path):
        _read_block(path, first_line, lines, grown)
    if grown.n_faces == 0:
        raise InputError(path, "", "the mesh has no faces", "Give an OBJ file with `v` and `f` lines")
    mesh = ObjMesh(
        np.concatenate(grown.vertices) if grown.vertices else np.zeros((0, 3)),
        np.concatenate(grown.uv) if grown.uv else np.zeros((0, 2)),
        np.concatenate(grown.faces),
        np.concatenate(grown.uv_faces),
        np.array(grown.starts[b"o"] or grown.starts[b"g"], np.int64),
    )
    _check_indices(path, mesh)
    return mesh


@dataclass(frozen=True)
class ObjHeader:
    """What the materials of an OBJ file are called."""

    material_library: str
    materials: tuple[str, ...]


def read_obj_header(path: Path) -> ObjHeader:
    """The mtllib and usemtl names of a file, without parsing its numbers. Raises InputError."""
    libraries: dict[str, None] = {}
    materials: dict[str, None] = {}
    for _, lines in _blocks(path):
        for line in lines:
            if line.startswith(b"mtllib "):
                libraries[line[7:].strip().decode("utf-8", "replace")] = None
            elif line.startswith(b"usemtl "):
                materials[line[7:].strip().decode("utf-8", "replace")] = None
        if max(len(libraries), len(materials)) > MAX_NAMES:
            raise InputError(path, "", f"the mesh has more than {MAX_NAMES:,} materials", "Join them")
    return ObjHeader(next(iter(libraries), ""), tuple(materials))


def _blocks(path: Path) -> Iterator[tuple[int, list[bytes]]]:
    """Yields (number of the first line, lines), each block about `BLOCK_BYTES` long."""
    with open_regular(path, MAX_FILE_BYTES, "Give a text OBJ file of a simplified mesh") as file:
        rest, line_number = b"", 1
        while block := file.read(BLOCK_BYTES):
            lines = (rest + block).split(b"\n")
            rest = lines.pop()
            if len(rest) > BLOCK_BYTES:
                raise InputError(path, f"line {line_number}", "the line is too long", "Give a text OBJ file")
            yield line_number, lines
            line_number += len(lines)
            if line_number > MAX_LINES:
                raise InputError(path, "", f"more than {MAX_LINES:,} lines", "Simplify the mesh")
        yield line_number, [rest]


def _refuse_at_a_glance(path: Path) -> None:
    """Counts lines that begin a face, hundreds of times faster than reading them."""
    count = 0
    with open_regular(path, MAX_FILE_BYTES, "Give a text OBJ file of a simplified mesh") as file:
        while count <= MAX_FACES and (block := file.read(BLOCK_BYTES)):
            count += block.count(b"\nf ")
    if count > MAX_FACES:
        raise InputError(path, "", f"the mesh has more than {MAX_FACES:,} faces", "Simplify the mesh")


def _read_block(path: Path, first_line: int, lines: list[bytes], grown: _Growing) -> None:
    by_keyword: dict[bytes, list[int]] = {b"v": [], b"vt": [], b"f": []}
    for index, line in enumerate(lines):
        keyword, _, _ = line.lstrip().partition(b" ")
        known = by_keyword.get(keyword)
        if known is not None:
            known.append(index)
        elif keyword in grown.starts:
            # Counted in face lines of this block; turned into face indices below.
            grown.starts[keyword].append(-1 - len(by_keyword[b"f"]))
        elif b"\t" in keyword:
            raise InputError(
                path, f"line {first_line + index}", "a tab follows the keyword", "Put a space there"
            )

    vertices = _numbers(path, first_line, lines, by_keyword[b"v"], 3)
    uv = _numbers(path, first_line, lines, by_keyword[b"vt"], 2)
    face_lines = by_keyword[b"f"]
    # Negative indices count back from what precedes the face in the file.
    seen_v = grown.n_vertices + np.searchsorted(by_keyword[b"v"], face_lines)
    seen_t = grown.n_uv + np.searchsorted(by_keyword[b"vt"], face_lines)
    faces, uv_faces, first_face = _triangles(path, first_line, lines, face_lines, seen_v, seen_t)
    for starts in grown.starts.values():
        starts[:] = [grown.n_faces + int(first_face[-1 - s]) if s < 0 else s for s in starts]

    grown.vertices.append(vertices)
    grown.uv.append(uv)
    grown.faces.append(faces)
    grown.uv_faces.append(uv_faces)
    grown.n_vertices += len(vertices)
    grown.n_uv += len(uv)
    grown.n_faces += len(faces)
    if max(map(len, grown.starts.values())) > MAX_NAMES:
        raise InputError(path, "", f"the mesh has more than {MAX_NAMES:,} groups", "Join them")
    if grown.n_faces > MAX_FACES or max(grown.n_vertices, grown.n_uv) > MAX_VERTICES:
        raise InputError(
            path,
            "",
            f"the mesh has more than {MAX_FACES:,} faces or {MAX_VERTICES:,} vertices",
            "Simplify the mesh",
        )


def _numbers(path: Path, first_line: int, lines: list[bytes], rows: list[int], width: int) -> F64:
    """The first `width` numbers of the given lines, (N, width)."""
    if not rows:
        return np.zeros((0, width))
    values = _table([lines[r] for r in rows], np.float64, tuple(range(1, width + 1)))
    if values is None:
        bad = next(r for r in rows if _table([lines[r]], np.float64, tuple(range(1, width + 1))) is None)
        raise _bad_line(path, first_line + bad, lines[bad], f"{width} numbers are needed")
    finite = np.isfinite(values).all(axis=1)
    if not finite.all():
        bad = rows[int(np.argmin(finite))]
        raise _bad_line(path, first_line + bad, lines[bad], "a number is not finite")
    return values


def _table(lines: list[bytes], dtype: Any, columns: tuple[int, ...] | None) -> npt.NDArray[Any] | None:
    try:
        text = [line.decode("ascii") for line in lines]
        return np.loadtxt(text, dtype=dtype, comments=None, usecols=columns, ndmin=2)
    except (ValueError, OverflowError):
        return None


def _triangles(
    path: Path, first_line: int, lines: list[bytes], rows: list[int], seen_v: I64, seen_t: I64
) -> tuple[I64, I64, I64]:
    """Faces (F, 3), texture faces (F, 3) and, for each face line and the end, its first triangle."""
    if not rows:
        return np.zeros((0, 3), np.int64), np.zeros((0, 3), np.int64), np.zeros(1, np.int64)
    corners = [_SPACES.sub(b" ", lines[r].strip()[2:].strip()) for r in rows]
    shapes = _INTEGER.sub(b"0", b"\n".join(corners)).split(b"\n")
    first_seen: dict[bytes, int] = {}
    kind = np.array([first_seen.setdefault(shape, len(first_seen)) for shape in shapes])
    n_corners = np.empty(len(rows), np.int64)
    for number, shape in enumerate(first_seen):
        if not _CORNERS.fullmatch(shape) or shape.count(b" ") < 2:
            bad = int(np.argmax(kind == number))
            raise _bad_line(
                path, first_line + rows[bad], lines[rows[bad]], "a face needs 3 or more corners, all alike"
            )
        n_corners[kind == number] = shape.count(b" ") + 1

    first_face = np.concatenate([[0], np.cumsum(n_corners - 2)])
    faces = np.empty((first_face[-1], 3), np.int64)
    uv_faces = np.full((first_face[-1], 3), -1, np.int64)
    for number, shape in enumerate(first_seen):
        of_kind = np.flatnonzero(kind == number)
        flat = [corners[k].replace(b"/", b" ") for k in of_kind]
        table = _table(flat, np.int64, None)
        if table is None:
            bad = next(
                int(k)
                for k, line in zip(of_kind, flat, strict=True)
                if _table([line], np.int64, None) is None
            )
            raise _bad_line(path, first_line + rows[bad], lines[rows[bad]], "an index is not a number")
        count = int(n_corners[of_kind[0]])
        table = table.reshape(len(of_kind), count, -1)
        v = _absolute(table[:, :, 0], seen_v[of_kind])
        has_uv = b"0/0" in shape
        t = _absolute(table[:, :, 1], seen_t[of_kind]) if has_uv else np.full_like(v, -1)
        low = v.min(axis=1) if not has_uv else np.minimum(v.min(axis=1), t.min(axis=1))
        if low.min() < 0:
            bad = rows[int(of_kind[np.argmin(low)])]
            raise _bad_line(path, first_line + bad, lines[bad], "an index is out of range")
        for fan in range(count - 2):
            where = first_face[of_kind] + fan
            faces[where] = v[:, [0, fan + 1, fan + 2]]
            uv_faces[where] = t[:, [0, fan + 1, fan + 2]]
    return faces, uv_faces, first_face


def _absolute(index: I64, seen: I64) -> I64:
    """OBJ indices (1 = first, -1 = last so far) as indices from 0; -1 where there is no such element."""
    absolute = np.where(index > 0, index - 1, seen[:, None] + index)
    return np.where((index == 0) | (absolute < 0), -1, absolute)


def _check_indices(path: Path, mesh: ObjMesh) -> None:
    for what, index, count in (
        ("vertex", mesh.faces, len(mesh.vertices)),
        ("texture coordinate", mesh.uv_faces, len(mesh.uv)),
    ):
        high = index.max(axis=1)
        if high.max() >= count:
            raise InputError(
                path,
                f"face {int(np.argmax(high >= count)) + 1}",
                f"refers to {what} {int(high.max()) + 1} of {count}",
                "Export the mesh again; it may be cut off",
            )


def _bad_line(path: Path, number: int, line: bytes, problem: str) -> InputError:
    shown = line[:60].decode("utf-8", "replace").strip()
    return InputError(path, f"line {number}", f"{problem}: {shown!r}", "Export the mesh again as text OBJ")

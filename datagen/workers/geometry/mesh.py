"""A coloured triangle mesh, the only surface type that loaders return."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I32 = npt.NDArray[np.int32]
U8 = npt.NDArray[np.uint8]
BOX_BITS = (np.arange(8)[:, None] >> np.arange(3)) & 1  # (8, 3), 1 where a box's corner is at the high end


@dataclass(frozen=True, eq=False)
class Texture:
    """An image on a mesh; `uv` has its origin at the image's lower left corner, as in OBJ."""

    image: U8  # (H, W, 3)
    uv: F32  # (V, 2), one per vertex of the mesh


@dataclass(frozen=True, eq=False)
class MeshFile:
    """The file that a mesh was read from; pictures read its textures again."""

    path: Path
    faces: I32  # (F,), of the mesh, as rows of the file's faces


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with a flat colour each and optionally a texture that overrides it."""

    vertices_m: F32  # (V, 3)
    faces: I32  # (F, 3)
    face_rgb: U8  # (F, 3)
    texture: Texture | None = None
    file: MeshFile | None = None

    def transformed(self, T_parent_mesh: F64) -> Mesh:
        return replace(self, vertices_m=transformed(self.vertices_m, T_parent_mesh).astype(np.float32))


def transformed(points_m: F32 | F64, T: F64) -> F64:
    """Points (..., 3) moved by a transform (4, 4)."""
    return points_m @ T[:3, :3].T + T[:3, 3]


def transformed_parts(parts_m: Iterable[F32 | F64], T: F64) -> tuple[F32, ...]:
    """The corners (V, 3) of each part moved by a transform (4, 4)."""
    return tuple(transformed(part, T).astype(np.float32) for part in parts_m)


def face_normals(corners_m: F32) -> F32:
    """Unit normals (F, 3) of faces given by their corners (F, 3, 3); zero for a face without area."""
    normals = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)


def concatenate(meshes: list[Mesh]) -> Mesh:
    """One untextured mesh with the faces of all, in order; textures become flat face colours."""
    if not meshes:
        return Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8))
    offsets = np.cumsum([0] + [len(m.vertices_m) for m in meshes[:-1]])
    return Mesh(
        np.concatenate([m.vertices_m for m in meshes]),
        np.concatenate([m.faces + np.int32(o) for m, o in zip(meshes, offsets, strict=True)]),
        np.concatenate([m.face_rgb for m in meshes]),
    )


def vertex_components(faces: npt.NDArray[np.integer[Any]], n_vertices: int) -> npt.NDArray[np.int32]:
    """Component index (n_vertices,) of each vertex; faces (F, 3) join their vertices."""
    # Imported here: commands without geometry would wait for it.
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    first, second = faces[:, [0, 1, 1, 2]].reshape(-1, 2).T
    joined = coo_matrix((np.ones(len(first), np.bool_), (first, second)), (n_vertices, n_vertices))
    return connected_components(joined, directed=False)[1]

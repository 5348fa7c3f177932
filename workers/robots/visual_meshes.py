"""Meshes of a robot to look at."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from datagen.workers.geometry.mesh import F32, Mesh, concatenate
from datagen.workers.houses.glb import read_glb
from datagen.workers.robots.assembly import LinkBody
from datagen.workers.robots.hulls import hull_faces

_GREY = 190


def body_mesh(body: LinkBody) -> Mesh:
    """A body's visual meshes, else its hulls, in the link frame. Raises InputError naming a broken file."""
    meshes: list[Mesh] = []
    for shape in body.visuals:
        assert shape.mesh is not None
        T = np.diag([body.scale] * 3 + [1.0]) @ shape.T_link_shape @ np.diag([*shape.scale, 1.0])
        meshes.append(_glb(shape.mesh).transformed(T))
    return concatenate([*meshes, *(_plain(part) for part in body.drawn_m)])


@lru_cache(maxsize=64)
def _glb(path: Path) -> Mesh:
    return read_glb(path)


def _plain(corners_m: F32) -> Mesh:
    faces, _ = hull_faces(corners_m)
    return Mesh(corners_m, faces, np.full((len(faces), 3), _GREY, np.uint8))

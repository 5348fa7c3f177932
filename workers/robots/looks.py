"""Meshes of a robot to look at."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

from workers.geometry.mesh import Mesh, concatenate
from workers.robots.assembly import Body

_GREY = 200


def body_mesh(body: Body) -> Mesh:
    """The hulls of a body, link frame."""
    meshes: list[Mesh] = []
    for part in body.parts_m:
        faces = ConvexHull(part).simplices.astype(np.int32)
        meshes.append(Mesh(part, faces, np.full((len(faces), 3), _GREY, np.uint8)))
    return concatenate(meshes)

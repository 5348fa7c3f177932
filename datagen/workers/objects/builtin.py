"""The embedded default set of objects: parametric solids with published YCB sizes and masses."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.identity import digest_of
from datagen.workers.geometry.mesh import Mesh
from datagen.workers.objects import shapes
from datagen.workers.objects.builtin_table import RECIPES
from datagen.workers.objects.convex import convex_parts, fits_gripper
from datagen.workers.objects.model import LoadedOnce, ObjectModel
from datagen.workers.objects.shapes import ParametricSolid
from datagen.workers.objects.ycb_masses import PUBLISHED_MASS_KG

# Part of every digest: raise it when a change of `shapes` or of the assembly here changes an object.
GENERATOR_VERSION = 1


class BuiltinObjects(LoadedOnce):
    """All recipes of `builtin_table`, each built once per process on first use; nothing is read from disk."""

    kind = "builtin"

    def __init__(self) -> None:
        self.excluded: Mapping[str, str] = {}
        self._digests = {name: _digest(name) for name in sorted(RECIPES)}
        self.digest, self._models = digest_of(self._digests), dict[str, ObjectModel]()

    def _model(self, name: str) -> ObjectModel:
        return _model(name)


def open_builtin(argument: str) -> BuiltinObjects:
    """The built-in objects; `argument` is empty."""
    if argument:
        raise InputError(f"builtin:{argument}", "", "built-in objects accept no folder", "Write `builtin`")
    return BuiltinObjects()


def _digest(name: str) -> str:
    return digest_of([GENERATOR_VERSION, name, PUBLISHED_MASS_KG[name], RECIPES[name]])


@cache
def _model(name: str) -> ObjectModel:
    solid = shapes.joined(*[_piece(piece) for piece in RECIPES[name]])
    vertices = solid.mesh.vertices_m.astype(np.float64)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    centre = (low + high) / 2
    centred = (vertices - centre).astype(np.float32)
    parts = convex_parts(part - centre for part in solid.parts_m)
    mass_kg = PUBLISHED_MASS_KG[name]
    size = high - low
    return ObjectModel(
        name=name,
        digest=_digest(name),
        mass_kg=mass_kg,
        size_m=(float(size[0]), float(size[1]), float(size[2])),
        radius_m=float(np.linalg.norm(centred.astype(np.float64), axis=1).max()),
        visual=Mesh(centred, solid.mesh.faces, solid.mesh.face_rgb),
        convex_parts_m=parts.vertices_m,
        can_be_target=fits_gripper(centred, parts, mass_kg),
    )


def _piece(piece: dict[str, Any]) -> ParametricSolid:
    """The solid of a piece, built by the functions of `shapes` that the piece names."""
    arguments = {key: value for key, value in piece.items() if key not in ("shape", "with", "put")}
    for key in arguments.keys() & {"centres_m", "radii_m"}:
        arguments[key] = np.array(arguments[key], np.float64)
    paint = {key: value for key, value in piece["with"].items() if key != "paint"}
    painted = getattr(shapes, piece["with"]["paint"])(**paint)
    return shapes.moved(getattr(shapes, piece["shape"])(**arguments, paint=painted), **piece["put"])

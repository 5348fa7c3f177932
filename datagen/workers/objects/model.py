"""A movable object as every source returns it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from datagen.workers.geometry.mesh import F32, Mesh


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """An object in its own frame: origin at the centre of its bounding box, z up at rest, metres.

    `visual` is rendered; physics and grasping use `convex_parts_m` (each (V, 3), the vertices of a
    convex polyhedron with volume). Both share the frame.
    """

    name: str  # "011_banana"
    digest: str  # sha256 over the files, or the parameters, that it is made from
    mass_kg: float
    size_m: tuple[float, float, float]  # sides of the bounding box
    radius_m: float  # radius of the smallest origin-centred sphere that holds every visual vertex
    visual: Mesh
    convex_parts_m: tuple[F32, ...]
    can_be_target: bool  # fits a parallel gripper with an 8 cm stroke from some side


class ObjectSource(Protocol):
    """A named set of objects. `excluded` maps excluded objects to reasons, `cause: detail`."""

    kind: str
    digest: str  # digest of the content, not of the path
    excluded: Mapping[str, str]

    def names(self) -> list[str]:
        """Usable objects, sorted."""
        ...

    def load(self, name: str) -> ObjectModel:
        """The model, cached. Raises InputError that names the file, the object and the field."""
        ...

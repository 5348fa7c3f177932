"""A movable object as every source returns it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from datagen.schemas.errors import InputError
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


class LoadedOnce(ABC):
    """A source whose models are made by `_model` and kept; `_digests` has those of the usable objects."""

    kind: str
    excluded: Mapping[str, str]
    _digests: Mapping[str, str]
    _models: dict[str, ObjectModel]

    def names(self) -> list[str]:
        """Usable objects, sorted."""
        return list(self._digests)

    def load(self, name: str) -> ObjectModel:
        """The model; the same object at every call. Raises InputError for an unknown name."""
        if name not in self._digests:
            reason = self.excluded.get(name, "there is no such object")
            raise InputError(f"{self.kind} objects", name, reason, "See `names()` for those that can be used")
        if name not in self._models:
            self._models[name] = self._model(name)
        return self._models[name]

    @abstractmethod
    def _model(self, name: str) -> ObjectModel:
        """Read the object of a usable name."""

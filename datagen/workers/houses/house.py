"""A house as every source returns it: world frame, right-handed, z up, metres, floor at z = 0."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, Protocol

import numpy as np

from datagen.schemas.specification import PlaceKind
from datagen.workers.geometry.mesh import F32, F64, Mesh

BodyKind = Literal["wall", "furniture", "small"]


@dataclass(frozen=True, eq=False)
class Room:
    """A floor. `polygon_m` is simple, counter-clockwise seen from above, without a repeated last corner."""

    room_id: str
    room_type: str  # Kitchen, LivingRoom, Bedroom, Bathroom, ...
    polygon_m: F64  # (K, 2)


@dataclass(frozen=True, eq=False)
class StaticBody:
    """One rigid static body: a wall, a piece of furniture or a small object on furniture.

    `visual` is rendered and `convex_parts_m` are used for collisions, both in the world frame.
    Every part is the vertex set of a convex polyhedron with volume.
    """

    body_id: str
    kind: BodyKind
    object_type: str  # "Wall", "DiningTable", "Apple", ...
    asset_id: str  # "" for walls
    room_id: str  # "" for walls
    visual: Mesh
    convex_parts_m: tuple[F32, ...]  # each (V, 3)


@dataclass(frozen=True, eq=False)
class Surface:
    """A horizontal rectangle of a body that can support objects.

    The frame `T_world_surface` has its origin at the rectangle's centre and z up.
    """

    surface_id: str
    body_id: str
    object_type: str
    room_id: str
    T_world_surface: F64  # (4, 4)
    size_m: tuple[float, float]  # along the surface frame's x and y
    kind: PlaceKind = "top"

    @property
    def height_m(self) -> float:
        return float(self.T_world_surface[2, 3])


@dataclass(frozen=True, eq=False)
class House:
    """Static surroundings of a scene."""

    house_id: str
    digest: str  # sha256 of the house's own bytes in its source
    rooms: tuple[Room, ...]
    bodies: tuple[StaticBody, ...]
    surfaces: tuple[Surface, ...]
    # Things that are left out or implausible, counted by cause.
    findings: Mapping[str, int] = field(default_factory=dict)
    # Builds it with open doors and all kinds of places; None where the source knows only tops.
    open_doors: Callable[[], House] | None = None
    # Names of the materials of floors and walls by their colours.
    materials: Mapping[tuple[int, int, int], str] = field(default_factory=dict)

    @cached_property
    def parts_m(self) -> list[F32]:
        """The convex parts of all bodies, each (V, 3)."""
        return [part for body in self.bodies for part in body.convex_parts_m]

    @cached_property
    def part_boxes_m(self) -> tuple[F32, F32]:
        """Lowest and highest corners (P, 3) of the bounding boxes of `parts_m`."""
        points_m = np.concatenate([np.empty((0, 3), np.float32), *self.parts_m])
        starts = np.cumsum([0, *map(len, self.parts_m)])[:-1]
        return np.minimum.reduceat(points_m, starts), np.maximum.reduceat(points_m, starts)

    def room(self, room_id: str) -> Room:
        return next(r for r in self.rooms if r.room_id == room_id)


class HouseSource(Protocol):
    """An ordered collection of houses. Opening one is cheap; loading a house takes milliseconds."""

    @property
    def kind(self) -> str:
        """The registry name."""
        ...

    @property
    def digest(self) -> str:
        """Hash of the content, not of the path."""
        ...

    def house_ids(self) -> list[str]:
        """All ids, in an order that depends on the content alone."""
        ...

    def load(self, house_id: str) -> House:
        """The house. Raises InputError that names the file, the house and the field."""
        ...

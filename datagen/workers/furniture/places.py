"""Places other than tops where objects can stand: boards of shelves, inside cupboards, seats and basins.

They are found from the shape itself, so that a place is where a board is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from datagen.schemas.specification import PlaceKind
from datagen.workers.furniture.asset_geometry import asset_geometry
from datagen.workers.furniture.assets import Asset, Rectangle, top_height_m
from datagen.workers.geometry.mesh import F32, F64

# The kind of place that a type of furniture has, apart from its top.
_KINDS: dict[str, PlaceKind] = {
    **dict.fromkeys(
        ("Cart", "CoffeeTable", "Desk", "Shelf", "ShelvingUnit", "SideTable", "TVStand"), "shelf"
    ),
    **dict.fromkeys(("Cabinet", "CounterTop", "Dresser", "Fridge", "Microwave"), "inside"),
    **dict.fromkeys(("ArmChair", "Bed", "Chair", "Footstool", "Ottoman", "Sofa"), "seat"),
    "Sink": "sink",
}
# A board is at least this wide, with this much room above, and a seat this wide.
NARROWEST_M, _HEADROOM_M, _SEAT_M = 0.2, 0.12, 0.3
# Parts that begin this close above a board lie on it; sides that overlap it by less do not cover it.
_ON_M, _BESIDE_M = 0.03, 0.02
# Width of the floor around furniture that belongs to its place.
_AROUND_M = 0.4


@dataclass(frozen=True)
class Place:
    """A horizontal rectangle in the asset's own frame on which objects can stand."""

    kind: PlaceKind
    rectangle: Rectangle
    height_m: float


@lru_cache(maxsize=8192)
def places_of(asset: Asset) -> tuple[Place, ...]:
    """The places of an asset with its doors open, tops left out."""
    kind = _KINDS.get(asset.object_type)
    if kind is None:
        return ()
    low, high = _boxes(asset_geometry(asset, is_open=True)[1])
    top_m = top_height_m(asset) if kind in ("shelf", "inside") else np.inf
    found = list[Place]()
    for k in np.flatnonzero(_are_boards(asset, kind)):
        (x0, y0), (x1, y1), height_m = low[k, :2].tolist(), high[k, :2].tolist(), float(high[k, 2])
        if height_m < top_m - 0.01 and _headroom_m(low, high, int(k)) >= _HEADROOM_M:
            found.append(Place(kind, Rectangle((x0, x1), (y0, y1)), height_m))
    return tuple(found)


def floor_around(asset: Asset) -> Place:
    """The floor beside and below a piece of furniture."""
    x, y, _ = asset.halves_m
    x, y = x + _AROUND_M, y + _AROUND_M
    return Place("floor", Rectangle((-x, x), (-y, y)), 0.0)


def _boxes(parts_m: tuple[F32, ...]) -> tuple[F64, F64]:
    """Lowest and highest corners (P, 3) of the bounding boxes of the parts."""
    corners = np.array([(part.min(0), part.max(0)) for part in parts_m], np.float64)
    return corners[:, 0], corners[:, 1]


def _are_boards(asset: Asset, kind: PlaceKind) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Whether each part (P,) is a box, parallel to the axes, that is wide enough."""
    parts_m = asset_geometry(asset, is_open=True)[1]
    low, high = _boxes(parts_m)
    boxes = [
        bool(((part == part.min(0)) | (part == part.max(0))).all()) and len(part) == 8 for part in parts_m
    ]
    widest_m = (high - low)[:, :2].min(1)
    return np.array(boxes) & (widest_m >= (_SEAT_M if kind == "seat" else NARROWEST_M))


def _headroom_m(low: F64, high: F64, k: int) -> float:
    """Free height above the top of box `k`; 0 where other parts lie on more than half of it."""
    inner_low, inner_high = low[k, :2] + _BESIDE_M, high[k, :2] - _BESIDE_M
    sides = np.minimum(high[:, :2], inner_high) - np.maximum(low[:, :2], inner_low)
    share = np.prod(np.maximum(sides, 0.0), axis=1) / np.prod(inner_high - inner_low)
    above = (share > 0) & (high[:, 2] > high[k, 2] + 1e-6)
    if share[above & (low[:, 2] < high[k, 2] + _ON_M)].sum() > 0.5:
        return 0.0
    covers = above & (low[:, 2] >= high[k, 2] + _ON_M) & (share > 0.25)
    return float((low[covers, 2] - high[k, 2]).min(initial=np.inf))

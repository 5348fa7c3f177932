"""Places of furniture with open doors: a board with room above it, which the open side leads to."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.workers.furniture.asset_geometry import asset_geometry
from datagen.workers.furniture.assets import Asset
from datagen.workers.furniture.places import places_of
from datagen.workers.houses.house import StaticBody
from datagen.workers.procedural_houses.room_layout import BUILTIN_ASSETS
from tests.workers.houses.house_checks import check_body, is_convex

KINDS = {
    "shelf": ("Cart", "CoffeeTable", "Shelf", "ShelvingUnit", "SideTable", "TVStand"),
    "inside": ("Cabinet", "CounterTop", "Dresser", "Fridge", "Microwave"),
    "seat": ("ArmChair", "Bed", "Chair", "Footstool", "Ottoman", "Sofa"),
    "sink": ("Sink",),
}
TYPES = sorted(name for names in KINDS.values() for name in names)


def is_free(asset: Asset, points_m: np.ndarray) -> np.ndarray:
    """Whether each point (N, 3), asset frame, is outside the bounding boxes of all parts."""
    _, parts_m = asset_geometry(asset, is_open=True)
    boxes = np.array([(part.min(0), part.max(0)) for part in parts_m])
    inside = (points_m[:, None] > boxes[:, 0]) & (points_m[:, None] < boxes[:, 1])
    return ~inside.all(2).any(1)


@given(
    st.sampled_from(TYPES),
    st.tuples(st.floats(0.4, 2.5), st.floats(0.3, 1.2), st.floats(0.3, 2.2)),
    st.integers(0, 20),
    st.lists(st.floats(0.05, 2.0), max_size=5),
)
@settings(max_examples=150, deadline=None)
def test_places_lie_on_boards_below_free_room(
    object_type: str, size: tuple[float, float, float], name: int, levels: list[float]
) -> None:
    low = tuple(sorted(level for level in levels if level < size[2] - 0.05))
    asset = Asset(f"Some_{name}", object_type, size, None, low)
    mesh, parts_m = asset_geometry(asset, is_open=True)
    assert all(is_convex(part) for part in parts_m)
    check_body(StaticBody("b", "furniture", object_type, asset.asset_id, "", mesh, parts_m))
    for place in places_of(asset):
        assert object_type in KINDS[place.kind]
        assert any(float(part[:, 2].max()) == pytest.approx(place.height_m) for part in parts_m)
        x = np.linspace(*place.rectangle.x, 9)[1:-1]
        y = np.linspace(*place.rectangle.y, 9)[1:-1]
        above = np.stack(np.meshgrid(x, y, [place.height_m + 0.04, place.height_m + 0.11]), -1)
        assert is_free(asset, above.reshape(-1, 3)).mean() > 0.4


@pytest.mark.parametrize("asset_id", sorted(BUILTIN_ASSETS))
def test_an_arm_reaches_inside_from_the_front(asset_id: str) -> None:
    asset = BUILTIN_ASSETS[asset_id]
    for place in places_of(asset):
        if place.kind not in ("shelf", "inside"):
            continue
        (cx, cy), front = place.rectangle.centre_m, asset.size_m[1] / 2 + 0.05
        along = np.array([(cx, y, place.height_m + 0.06) for y in np.linspace(cy, front, 20)])
        free = is_free(asset, along + (0.07, 0.0, 0.0)) | is_free(asset, along - (0.07, 0.0, 0.0))
        assert free.all(), place


def test_every_kind_of_place_is_found_in_built_in_furniture() -> None:
    found = {place.kind for asset in BUILTIN_ASSETS.values() for place in places_of(asset)}
    assert found == set(KINDS)

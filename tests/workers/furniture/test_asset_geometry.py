"""Every shape of every type, over the sizes that occur and beyond."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.workers.furniture.asset_geometry import SHAPES, asset_geometry
from datagen.workers.furniture.assets import (
    CARRYING_TYPES,
    Asset,
    hutch_depth_m,
    top_height_m,
    top_rectangles,
)
from datagen.workers.houses.house import StaticBody
from datagen.workers.procedural_houses.room_layout import BUILTIN_ASSETS
from tests.workers.houses.house_checks import check_body, hull_volume, is_convex, signed_volume

SIDE = st.floats(0.02, 2.5)


def body_of(asset: Asset) -> StaticBody:
    mesh, parts = asset_geometry(asset)
    return StaticBody("b", "furniture", asset.object_type, asset.asset_id, "", mesh, parts)


def check_shape(asset: Asset) -> None:
    body, slack = body_of(asset), 0.02
    check_body(body)
    for part in body.convex_parts_m:
        assert is_convex(part)
        assert 6 <= len(part) <= 24
    # Faces look outwards: the enclosed volume is positive and that of the parts.
    assert signed_volume(body) == pytest.approx(hull_volume(body), rel=0.02)  # slanted sides may be folded
    v = body.visual.vertices_m
    width, depth, height = asset.size_m
    top = max(height, top_height_m(asset), asset.rest_height_m or 0.0)
    assert v[:, 2].min() >= -1e-5
    assert v[:, 2].max() <= top + 0.12
    assert np.abs(v[:, 0]).max() <= width / 2 + slack
    assert np.abs(v[:, 1]).max() <= depth / 2 + slack


@pytest.mark.parametrize("asset_id", sorted(BUILTIN_ASSETS))
def test_built_in_furniture_is_convex_closed_and_of_its_size(asset_id: str):
    asset = BUILTIN_ASSETS[asset_id]
    check_shape(asset)
    v = asset_geometry(asset)[0].vertices_m
    assert v[:, 2].min() == pytest.approx(0, abs=1e-5)
    assert v[:, 2].max() >= 0.9 * asset.size_m[2]


@pytest.mark.parametrize("object_type", [*sorted(SHAPES), "NeverHeardOf"])
@given(
    st.tuples(st.floats(0.3, 2.5), st.floats(0.3, 1.5), st.floats(0.35, 2.2)), st.none() | st.floats(0.3, 2.0)
)
@settings(max_examples=8, deadline=None)
def test_every_type_at_the_size_of_furniture(object_type: str, size: tuple, rest: float | None):
    rest = rest if rest is None or rest < size[2] + 0.05 else None
    check_shape(Asset("Some_1", object_type, size, rest))


@given(st.sampled_from(sorted(SHAPES)), SIDE, SIDE, SIDE)
@settings(max_examples=60, deadline=None)
def test_odd_proportions_give_solids(object_type: str, width: float, depth: float, height: float):
    asset = Asset("Some_2", object_type, (width, depth, height))
    body = body_of(asset)
    assert np.isfinite(body.visual.vertices_m).all() and body.convex_parts_m
    if object_type in ("Apple", "Mug", "Book", "Bottle", "Bowl", "Box", "Candle", "Plate", "Vase"):
        check_body(body)


@given(st.sampled_from(sorted(CARRYING_TYPES)), st.floats(0.4, 2.5), st.floats(0.3, 1.2), st.floats(0.4, 2.0))
@settings(max_examples=60, deadline=None)
def test_tops_are_where_the_layout_says(object_type: str, width: float, depth: float, height: float):
    asset = Asset("Some_3", object_type, (width, depth, height))
    _, parts = asset_geometry(asset)
    for r in top_rectangles(asset):
        middle = np.array(r.centre_m)
        there = [p for p in parts if (p.min(0)[:2] <= middle).all() and (middle <= p.max(0)[:2]).all()]
        assert max(p[:, 2].max() for p in there) == pytest.approx(top_height_m(asset), abs=1e-5)
    assert hutch_depth_m(asset) == 0.0


def test_colours_differ_between_assets_and_not_between_calls():
    sofas = [Asset(f"Sofa_{k}", "Sofa", (2.0, 0.9, 0.8)) for k in range(20)]
    colours, again = ([asset_geometry(sofa)[0].face_rgb for sofa in sofas] for _ in range(2))
    np.testing.assert_array_equal(colours, again)
    assert len({tuple(rgb[-1]) for rgb in colours}) > 8

"""Forty houses of the real set, spread over it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from datagen.workers.geometry.planar import inside_any
from datagen.workers.houses import open_houses
from datagen.workers.houses.house import House, HouseSource
from tests.workers.houses.house_checks import check_house, top_below_m


@pytest.fixture(scope="module")
def source(assets: Path) -> HouseSource:
    return open_houses(f"procthor:{assets / 'procthor'}")


@pytest.fixture(scope="module")
def houses(source: HouseSource) -> list[House]:
    ids = source.house_ids()
    return [source.load(i) for i in ids[:: len(ids) // 40]]


def test_the_set_is_whole_and_its_houses_satisfy_the_contract(source: HouseSource, houses: list[House]):
    assert len(source.house_ids()) == 2018
    assert source.house_ids() == sorted(source.house_ids())
    for house in houses:
        check_house(house)


def test_surfaces_lie_exactly_on_their_furniture(houses: list[House]):
    count = 0
    for house in houses:
        for s in house.surfaces:
            if 0.3 <= s.height_m <= 1.2 and min(s.size_m) >= 0.3:
                np.testing.assert_allclose(top_below_m(house, s.surface_id), 0, atol=1e-4)
                count += 1
    assert count > 80


def test_small_things_on_tops_neither_float_nor_sink(houses: list[House]):
    gaps = []
    for house in houses:
        for s in house.surfaces:
            T = s.T_world_surface
            for b in house.bodies:
                v = b.visual.vertices_m
                low = v[:, 2].min() - s.height_m
                middle = ((v.min(0) + v.max(0)) / 2 - T[:3, 3]) @ T[:3, :3]
                is_on = (np.abs(middle[:2]) < np.array(s.size_m) / 2).all() and abs(low) < 0.1
                if b.kind == "small" and is_on:
                    gaps.append(low)
    assert len(gaps) > 200
    assert np.mean(np.abs(gaps) < 1e-3) > 0.97


def test_the_asset_database_that_is_fetched_gives_the_same_houses(
    source: HouseSource, houses: list[House], assets: Path, tmp_path: Path
):
    """ProcTHOR's own table has sizes alone, where that of the real set has heights at which things rest."""
    table = json.loads((assets / "procthor/asset_sizes.json").read_text())
    entries = [
        {"assetId": i, "objectType": v["objectType"], "boundingBox": dict(zip("xyz", v["size"], strict=True))}
        for i, v in table.items()
    ]
    (tmp_path / "asset-database.json").write_text(json.dumps(entries))
    for file in (assets / "procthor").glob("*.jsonl.gz"):
        (tmp_path / file.name).symlink_to(file)
    fetched = open_houses(f"procthor:{tmp_path}")
    assert fetched.digest != source.digest
    for ours in houses[::2]:
        theirs = fetched.load(ours.house_id)
        assert [s.surface_id for s in theirs.surfaces] == [s.surface_id for s in ours.surfaces]
        for a, b in zip(theirs.bodies, ours.bodies, strict=True):
            np.testing.assert_array_equal(a.visual.vertices_m, b.visual.vertices_m)
        for a, b in zip(theirs.surfaces, ours.surfaces, strict=True):
            np.testing.assert_array_equal(a.T_world_surface, b.T_world_surface)


def test_furniture_stands_on_the_floor_inside_its_room(houses: list[House]):
    for house in houses:
        floors = [r.polygon_m for r in house.rooms]
        for b in (b for b in house.bodies if b.kind == "furniture"):
            v = b.visual.vertices_m.astype(np.float64)
            assert inside_any((v.min(0) + v.max(0))[None, :2] / 2, floors).all()
            may_hang = b.object_type in ("Painting", "Television", "BaseballBat")
            assert may_hang or abs(v[:, 2].min()) < 0.01, b.object_type

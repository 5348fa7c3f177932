"""Generated homes: connected, furnished, walkable, without overlap, the same everywhere."""

from __future__ import annotations

import itertools
import subprocess
import sys

import numpy as np
import pytest
from scipy import ndimage

from datagen.schemas.errors import InputError
from datagen.schemas.identity import digest_of
from datagen.workers.geometry.planar import inside_any
from datagen.workers.houses import open_houses
from datagen.workers.houses.house import House
from datagen.workers.procedural_houses.builtin import house_document
from datagen.workers.procedural_houses.floorplan import WALL_HEIGHT_M
from tests.workers.houses.house_checks import check_house, top_below_m

NUMBERS = range(0, 400, 13)


@pytest.fixture(scope="module")
def houses() -> list[House]:
    source = open_houses("builtin")
    return [source.load(source.house_ids()[k]) for k in NUMBERS]


def test_houses_satisfy_the_contract_and_have_a_kitchen_and_a_good_top(houses: list[House]):
    for house in houses:
        check_house(house)
        assert 2 <= len(house.rooms) <= 5
        assert any(r.room_type == "Kitchen" for r in house.rooms)
        good = [
            s for s in house.surfaces
            if 0.3 <= s.height_m <= 1.2 and min(s.size_m) >= 0.4 and max(s.size_m) >= 0.5
        ]  # fmt: skip
        assert good, house.house_id
        for s in good:
            np.testing.assert_allclose(top_below_m(house, s.surface_id), 0, atol=1e-4)


def test_furniture_stays_out_of_the_walls_and_of_each_other(houses: list[House]):
    for house in houses:
        bodies = [b for b in house.bodies if b.kind == "furniture"]
        for b in bodies:
            room, v = house.room(b.room_id).polygon_m, b.visual.vertices_m
            assert (v[:, :2] >= room.min(0) + 0.005).all() and (v[:, :2] <= room.max(0) - 0.005).all()
            assert v[:, 2].max() < WALL_HEIGHT_M
        boxes = [[(p.min(0), p.max(0)) for p in b.convex_parts_m] for b in bodies]
        whole = [(b.visual.vertices_m.min(0), b.visual.vertices_m.max(0)) for b in bodies]
        for i, j in itertools.combinations(range(len(bodies)), 2):
            if not meet(whole[i], whole[j]):
                continue
            # Only the empty corner of an L may be shared, or what hangs above what stands.
            hit = any(meet(a, b) for a in boxes[i] for b in boxes[j])
            assert not hit, (house.house_id, bodies[i].asset_id, bodies[j].asset_id)


def meet(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> bool:
    return bool((a[0] + 1e-3 < b[1]).all() and (b[0] + 1e-3 < a[1]).all())


def test_a_robot_reaches_every_room_from_every_other(houses: list[House]):
    """On a 10 cm raster with a body of 25 cm: the free floor of all rooms is one region."""
    for house in houses:
        corners = np.concatenate([r.polygon_m for r in house.rooms])
        xs, ys = (np.arange(corners.min(0)[k], corners.max(0)[k], 0.1) for k in (0, 1))
        grid = np.stack(np.meshgrid(xs, ys, indexing="ij"), -1).reshape(-1, 2)
        free = inside_any(grid, [r.polygon_m for r in house.rooms])
        for part in house.bodies:
            for p in part.convex_parts_m:
                if p[:, 2].min() < 1.0 and p[:, 2].max() > 0.02:
                    low, high = p.min(0)[:2] - 0.25, p.max(0)[:2] + 0.25
                    free &= ~((grid > low).all(1) & (grid < high).all(1))
        regions, _ = ndimage.label(free.reshape(len(xs), len(ys)))
        sizes = np.bincount(regions.ravel())[1:]
        main = np.argmax(sizes) + 1
        for room in house.rooms:
            here = inside_any(grid, [room.polygon_m]).reshape(len(xs), len(ys))
            assert (regions[here] == main).sum() > 20, (house.house_id, room.room_type)


def test_chairs_face_their_table_or_desk(houses: list[House]):
    seen = 0
    for number in NUMBERS:
        objects = house_document(number)["objects"]
        tables = [o for o in objects if o["assetId"].startswith(("DiningTable", "Desk_"))]
        for chair in (o for o in objects if o["assetId"].startswith("Chair")):
            t = np.deg2rad(chair["rotation"]["y"])
            front = np.array([np.sin(t), np.cos(t)])
            at = np.array([chair["position"]["x"], chair["position"]["z"]])
            to = [np.array([o["position"]["x"], o["position"]["z"]]) - at for o in tables]
            nearest = min(to, key=lambda d: float(np.linalg.norm(d)))
            assert nearest @ front > 0.4
            seen += 1
    assert seen > 50


def test_the_same_house_in_another_process_and_a_longer_collection():
    code = (
        "from datagen.workers.procedural_houses.builtin import house_document\n"
        "from datagen.schemas.identity import digest_of\n"
        "print(digest_of(house_document(7)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == digest_of(house_document(7))
    few, whole = open_houses("builtin:10"), open_houses("builtin")
    assert few.load("builtin-0007").digest == whole.load("builtin-0007").digest
    assert few.digest != whole.digest == open_houses("builtin:400").digest


@pytest.mark.parametrize("house_id", ["builtin-0400", "builtin-7", "builtin--001", "x", "builtin-00007", ""])
def test_unknown_ids_are_refused(house_id: str):
    with pytest.raises(InputError, match="no house"):
        open_houses("builtin").load(house_id)

"""Known answers: frames, walls and holes, what rests where, tops of corner counters, any floor."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.workers.geometry.planar import inside_polygon
from datagen.workers.houses import open_houses
from datagen.workers.houses.house import House
from datagen.workers.houses.things import unity_rotation
from datagen.workers.houses.walls_and_floors import clean_polygon, triangles
from tests.workers.houses.house_checks import check_house, covers, top_below_m
from tests.workers.houses.house_files import thing, two_rooms, wall, write_houses, xyz


def load(folder: Path, document: dict) -> House:
    source = open_houses(f"procthor:{write_houses(folder, [document])}")
    house = source.load(source.house_ids()[0])
    check_house(house)
    return house


def wall_covers(house: House, xy: tuple[float, float], z: float) -> bool:
    return any(covers(b, xy, z) for b in house.bodies if b.object_type in ("Wall", "Door"))


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> House:
    return load(tmp_path_factory.mktemp("house"), two_rooms())


def body(house: House, body_id: str):
    return next(b for b in house.bodies if b.body_id == body_id)


def test_positions_exchange_y_and_z_and_yaw_turns_about(house: House):
    table = body(house, "0|table").visual.vertices_m
    # 1.2 wide and 0.8 deep, turned by 90 degrees, centred at Unity (1.5, 0.375, 2.0).
    np.testing.assert_allclose(table.min(0)[:2], [1.5 - 0.4, 2.0 - 0.6], atol=1e-5)
    np.testing.assert_allclose(table.max(0)[:2], [1.5 + 0.4, 2.0 + 0.6], atol=1e-5)
    assert table.min() == 0.0


@pytest.mark.parametrize(("yaw", "front"), [(0, (0, 1)), (90, (1, 0)), (180, (0, -1)), (270, (-1, 0))])
def test_the_front_of_a_chair_turns_clockwise_with_yaw(tmp_path: Path, yaw: float, front: tuple[int, int]):
    document = two_rooms()
    document["objects"] = [thing("0|chair", "Chair_1", xyz(2, 0.45, 1.5), yaw)]
    vertices = body(load(tmp_path, document), "0|chair").visual.vertices_m
    high = vertices[vertices[:, 2] > 0.8].mean(0)[:2] - (2, 1.5)  # the backrest
    assert high @ np.array(front) < -0.2  # opposite to the front
    assert abs(high @ np.array([front[1], -front[0]])) < 1e-6


@given(st.floats(-360, 360), st.floats(-360, 360), st.floats(-360, 360))
@settings(max_examples=50, deadline=None)
def test_rotations_are_proper_and_follow_unity(x: float, y: float, z: float):
    rotation = unity_rotation(x, y, z)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) > 0.999
    # Unity turns a vector by z, x and y in this order about fixed axes, clockwise along each axis.
    v = np.array([0.3, -0.5, 0.8])
    for axis, angle in ((2, z), (0, x), (1, y)):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        t = np.deg2rad(angle)
        v[a], v[b] = np.cos(t) * v[a] - np.sin(t) * v[b], np.sin(t) * v[a] + np.cos(t) * v[b]
    np.testing.assert_allclose(rotation @ [0.3, 0.8, -0.5], v[[0, 2, 1]], atol=1e-9)


def test_things_rest_exactly_on_the_top_whether_lifted_or_not(house: House):
    surface = house.surfaces[0]
    assert surface.height_m == pytest.approx(0.755, abs=1e-6)
    for name in ("0|mug", "0|card"):
        assert body(house, name).visual.vertices_m[:, 2].min() == pytest.approx(0.755, abs=1e-5)
        assert body(house, name).kind == "small"
        assert body(house, name).room_id == "room|0"
    np.testing.assert_allclose(top_below_m(house, surface.surface_id), 0, atol=1e-5)


def test_the_inner_doorway_is_open_where_wall0_says(house: House):
    # wall0 runs from (4, 3) to (4, 0): 0.4 to 1.4 along it is y = 2.6 to 1.6.
    for y, is_solid in ((2.8, True), (2.55, False), (2.1, False), (1.65, False), (1.5, True), (0.3, True)):
        assert wall_covers(house, (4.0, y), 1.0) is is_solid, y
    assert wall_covers(house, (4.0, 2.1), 2.3)  # the lintel


def test_walls_of_both_rooms_become_one_with_two_colours(tmp_path: Path):
    document = two_rooms()
    next(w for w in document["walls"] if w["id"] == "w|1|west")["material"] = {
        "name": "x", "color": {"r": 1, "g": 0, "b": 0}
    }  # fmt: skip
    house = load(tmp_path, document)
    at_four = [
        b for b in house.bodies
        if b.object_type == "Wall" and np.abs(b.visual.vertices_m[:, 0] - 4.0).max() < 0.02
    ]  # fmt: skip
    assert len(at_four) == 1
    mesh = at_four[0].visual
    middle = mesh.vertices_m[mesh.faces].mean(1)
    right = mesh.face_rgb[np.isclose(middle[:, 0], 4.01, atol=1e-3)]
    left = mesh.face_rgb[np.isclose(middle[:, 0], 3.99, atol=1e-3)]
    assert (right == (255, 0, 0)).all() and len(right)  # seen from room 1
    assert (left == (128, 64, 255)).all() and len(left)


def test_windows_are_holes_above_a_sill_and_doors_to_the_outside_are_closed(house: House):
    # The east wall of room 1 runs from (8, 3) to (8, 0): 1 to 2 along it is y = 2 to 1.
    assert not wall_covers(house, (8.0, 1.5), 1.5)
    assert wall_covers(house, (8.0, 1.5), 0.5)
    assert wall_covers(house, (8.0, 1.5), 2.2)
    # The way out in the south wall, which runs from (4, 0) to (0, 0): x = 3 to 2.
    assert wall_covers(house, (2.5, 0.0), 1.0)
    assert any(b.object_type == "Door" for b in house.bodies)


def without_wall0(house: dict) -> None:
    house["walls"] = [w for w in house["walls"] if w["id"] != "w|0|east"]


def window_to_the_floor(house: dict) -> None:
    house["windows"][0]["holePolygon"] = [xyz(1, 0, 0), xyz(2, 2, 0)]


def open_walls(house: dict) -> None:
    house["doors"] = house["doors"][1:]
    for w in house["walls"]:
        w["empty"] = w["id"] in ("w|0|east", "w|1|west")


def wall_along_another(house: dict) -> None:
    house["walls"].append(wall("long", "room|1", (4.0, 0.0), (4.0, 5.0)))


@pytest.mark.parametrize(
    ("change", "free_m", "solid_m"),
    [
        (without_wall0, (4.0, 2.1, 1.0), (4.0, 0.9, 1.0)),  # the hole along wall1 is mirrored
        (window_to_the_floor, (8.0, 1.5, 0.5), (8.0, 1.5, 0.05)),  # what stops a base
        (open_walls, (4.0, 1.0, 1.0), (8.0, 0.5, 1.0)),
        (wall_along_another, (4.0, 2.1, 1.0), (4.0, 4.5, 1.0)),  # the door is not filled
    ],
)
def test_changed_walls_are_free_and_solid_where_they_must_be(
    tmp_path: Path,
    change: Callable[[dict], None],
    free_m: tuple[float, float, float],
    solid_m: tuple[float, float, float],
):
    document = two_rooms()
    change(document)
    house = load(tmp_path, document)
    assert not wall_covers(house, free_m[:2], free_m[2])
    assert wall_covers(house, solid_m[:2], solid_m[2])


def test_floors_lie_below_zero_and_cover_their_rooms(house: House):
    for k, room in enumerate(house.rooms):
        floor = body(house, f"floor-{room.room_id}")
        assert floor.visual.vertices_m[:, 2].max() == 0.0
        assert floor.room_id == room.room_id
        for x, y in ((0.5, 0.5), (3.5, 2.5), (2.0, 1.5)):
            assert covers(floor, (4 * k + x, y), -0.01)


def test_an_l_counter_leaves_its_corner_free(tmp_path: Path):
    document = two_rooms()
    document["objects"] = [thing("0|c", "Countertop_L_8x6", xyz(2, 0.47, 1.5))]
    house = load(tmp_path, document)
    counter = body(house, "0|c")
    # Back run along -z (world -y), wing at +x; the corner at (-x, +y) is empty.
    assert covers(counter, (1.0, 0.8), 0.5)
    assert covers(counter, (3.0, 2.2), 0.5)
    assert not covers(counter, (1.2, 2.0), 0.5)
    first, second = sorted(house.surfaces, key=lambda s: s.surface_id)
    assert first.size_m == pytest.approx((2.4, 0.61))
    assert second.size_m == pytest.approx((0.61, 1.8 - 0.61))
    np.testing.assert_allclose(second.T_world_surface[:3, 3], [2 + 1.2 - 0.305, 1.805, 0.943], atol=1e-6)
    for s in house.surfaces:
        np.testing.assert_allclose(top_below_m(house, s.surface_id), 0, atol=1e-5)


def test_a_desk_with_a_hutch_carries_things_in_front_of_it(tmp_path: Path):
    document = two_rooms()
    document["objects"] = [thing("0|desk", "Desk_9", xyz(2, 0.8, 1.5))]
    house = load(tmp_path, document)
    surface = house.surfaces[0]
    assert surface.height_m == pytest.approx(0.8)
    assert surface.size_m == pytest.approx((1.4, 0.45))
    np.testing.assert_allclose(top_below_m(house, surface.surface_id), 0, atol=1e-5)


def test_unknown_assets_and_hidden_objects_are_left_out(tmp_path: Path):
    document = two_rooms()
    document["objects"] += [
        thing("0|what", "0a1b", xyz(1, 1, 1), children=[thing("0|on", "Mug_1", xyz(1, 1.2, 1))]),
        thing("0|fridge", "Fridge_1", xyz(3, 0.9, 1), children=[thing("0|in", "Mug_1", xyz(3, 0.9, 1))]),
    ]
    house = load(tmp_path, document)
    things = {b.body_id for b in house.bodies if b.kind != "wall"}
    assert things == {"0|table", "0|mug", "0|card", "0|fridge"}
    assert [s.body_id for s in house.surfaces] == ["0|table"]


def test_a_tilted_bat_keeps_its_centre(tmp_path: Path):
    document = two_rooms()
    document["objects"] = [
        {"id": "0|bat", "assetId": "Bat_1", "position": xyz(2, 0.5, 1.5), "rotation": xyz(90, 0, 0)}
    ]
    vertices = body(load(tmp_path, document), "0|bat").visual.vertices_m
    np.testing.assert_allclose((vertices.min(0) + vertices.max(0)) / 2, [2, 1.5, 0.5], atol=1e-5)
    assert np.ptp(vertices[:, 1]) == pytest.approx(0.96, abs=1e-5)


def area(p: np.ndarray) -> float:
    q = np.roll(p, -1, axis=0)
    return float(0.5 * (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum())


@given(st.integers(3, 40), st.integers(0, 2**32 - 1), st.booleans())
@settings(max_examples=100, deadline=None)
def test_triangles_fill_any_star_shaped_polygon(corners: int, seed: int, is_clockwise: bool):
    rng = np.random.default_rng(seed)
    angle = np.sort((np.arange(corners) + rng.uniform(0, 0.9, corners)) * 2 * np.pi / corners)
    radius = rng.uniform(1.0, 5.0, corners)
    polygon = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
    cleaned = clean_polygon(polygon[::-1] if is_clockwise else polygon)
    if isinstance(cleaned, str):
        assert corners < 5  # three or four corners may leave the centre out
        return
    pieces = [cleaned[list(t)] for t in triangles(cleaned)]
    assert len(pieces) == len(cleaned) - 2
    assert all(area(t) >= -1e-9 for t in pieces)
    assert np.isclose(sum(area(t) for t in pieces), area(cleaned))
    middles = np.array([t.mean(0) for t in pieces if area(t) > 1e-6])
    assert inside_polygon(middles, cleaned).all()


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_rooms_with_right_angles_and_repeated_corners(seed: int):
    rng = np.random.default_rng(seed)
    a, b, c, d = rng.uniform(1, 4, 4)
    polygon = np.array(
        [[0, 0], [a + b, 0], [a + b, 0], [a + b, c], [a, c], [a, c + d], [a / 2, c + d], [0, c + d]]
    )
    cleaned = clean_polygon(polygon)
    assert not isinstance(cleaned, str)
    assert len(cleaned) == 6
    assert np.isclose(sum(area(cleaned[list(t)]) for t in triangles(cleaned)), (a + b) * c + a * d)


def test_things_outside_every_room_carry_nothing(tmp_path: Path):
    document = two_rooms()
    document["objects"] = [
        thing("out", "Table_1", xyz(20, 0.375, 2.0)),
        *(thing(f"chair {k}", "Chair_1", xyz(0.5 + 0.5 * k, 0.45, 1.0)) for k in range(8)),
    ]
    house = load(tmp_path, document)
    assert not house.surfaces and house.findings == {"implausible (outside its room)": 1}

"""Rooms of occupancy maps: each cell becomes what the map knows of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy import ndimage

from datagen import cli
from datagen.schemas.errors import InputError
from datagen.workers.bases.clearance import HouseObstacles, base_clearance_m
from datagen.workers.geometry.planar import convex_hull, inside_polygon
from datagen.workers.geometry.transforms import yaw_pose
from datagen.workers.houses import open_houses
from datagen.workers.houses.house import House, StaticBody
from datagen.workers.occupancy_map import FREE, OCCUPIED, UNKNOWN
from tests.workers.houses.house_checks import check_house, covers, top_below_m
from tests.workers.houses.map_files import COUNTER, STEP_M, TABLE, TOML, room_cells, write_map


def load(folder: Path, cells: np.ndarray, toml: str = TOML, origin: str = "0, 0, 0") -> House:
    house = open_houses(f"map:{write_map(folder, cells, toml, origin)}").load("lab")
    check_house(house)
    return house


def body(house: House, name: str) -> StaticBody:
    return next(b for b in house.bodies if b.body_id.endswith(name))


def held_by(house: House, name: str, xy_m: np.ndarray) -> np.ndarray:
    """How many parts of a body lie over each position (N, 2)."""
    return sum(
        inside_polygon(xy_m, convex_hull(part[:, :2])).astype(int)
        for part in body(house, name).convex_parts_m
    )


def test_a_table_stands_on_what_the_map_sees_below_it(tmp_path: Path) -> None:
    house = load(tmp_path, room_cells())
    assert not house.findings
    table, counter = house.surfaces
    assert (table.height_m, counter.height_m) == pytest.approx((0.74, 0.92))
    assert table.size_m == pytest.approx((1.4, 0.8), abs=0.021)  # of a raster of 2 cm
    assert counter.size_m == pytest.approx((2.9, 0.6), abs=0.021)
    for surface in house.surfaces:
        np.testing.assert_allclose(top_below_m(house, surface.surface_id), 0, atol=1e-6)
    for xy, under in (((1.82, 1.62), True), ((2.5, 2.0), False)):  # a leg, and free floor below the top
        assert covers(body(house, "table"), xy, 0.3) == under
        assert covers(body(house, "table"), xy, 0.72)
    assert covers(body(house, "counter"), (1.0, 3.6), 0.3)  # unknown below a support is not free
    assert body(house, "walls").visual.vertices_m[:, 2].max() == pytest.approx(2.4)


def test_a_turned_map_is_the_same_room_elsewhere(tmp_path: Path) -> None:
    plain = load(tmp_path / "a", room_cells(), f"occupied_height_m = 2.4\n{TABLE}")
    T = yaw_pose(-3.0, 2.0, 0.0, 0.7)
    table = TABLE.replace("centre_m = [2.5, 2.0]", f"centre_m = {(T @ [2.5, 2.0, 0, 1])[:2].tolist()}")
    turned = load(
        tmp_path / "b",
        room_cells(),
        f"occupied_height_m = 2.4\n{table}yaw_deg = {np.rad2deg(0.7)}\n",
        "-3.0, 2.0, 0.7",
    )
    np.testing.assert_allclose(
        turned.surfaces[0].T_world_surface, T @ plain.surfaces[0].T_world_surface, atol=1e-6
    )
    expected = plain.rooms[0].polygon_m @ T[:2, :2].T + T[:2, 3]
    np.testing.assert_allclose(turned.rooms[0].polygon_m, expected, atol=1e-9)


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.floats(-3.0, 3.0))
@example(237269, 1e-05)  # free pockets inside a room, and a number that YAML 1.1 takes for text
def test_each_cell_is_floor_wall_or_hidden_as_the_map_says(
    tmp_path_factory: pytest.TempPathFactory, seed: int, yaw: float
) -> None:
    rng = np.random.default_rng(seed)
    blocks = rng.choice([FREE, FREE, OCCUPIED, UNKNOWN], (9, 12))
    cells = np.kron(blocks, np.ones((6, 6), np.int8)).astype(np.int8)
    cells[6:34, 6:42] = FREE  # enough floor for a room, with a table in it
    toml = "occupied_height_m = 2.0\n[[support]]\nheight_m = 0.7\nsize_m = [0.6, 0.4]\n"
    T = yaw_pose(0.4, -0.2, 0.0, yaw)
    toml += f"centre_m = {(T @ [1.2, 1.0, 0, 1])[:2].tolist()}\nyaw_deg = {np.rad2deg(yaw)}\n"
    if not (cells == OCCUPIED).any():
        cells[0, 0] = OCCUPIED
    house = load(tmp_path_factory.mktemp("map"), cells, toml, f"0.4, -0.2, {yaw}")
    padded = np.pad(cells, 24, constant_values=UNKNOWN)
    rows, columns = np.mgrid[: padded.shape[0], : padded.shape[1]].reshape(2, -1)
    local = (np.stack([columns, rows]).T + 0.5 - 24) * STEP_M
    xy_m = local @ T[:2, :2].T + T[:2, 3]
    labels, _ = ndimage.label(padded == FREE)
    areas = np.bincount(labels.ravel()) * STEP_M**2
    floor = ((padded == FREE) & (areas[labels] >= 1.0 - 1e-9)).ravel()
    np.testing.assert_array_equal(held_by(house, "floor", xy_m), floor)
    near = ndimage.distance_transform_edt(padded != FREE).ravel() * STEP_M
    known = (padded.ravel() == OCCUPIED) | ((padded.ravel() == UNKNOWN) & (near <= 1.0))
    known |= (padded == FREE).ravel() & ~floor  # pockets
    clear = np.abs(near - 1.0) > 1e-6
    np.testing.assert_array_equal(held_by(house, "walls", xy_m)[clear], known[clear])
    indoors = np.any([inside_polygon(xy_m, room.polygon_m) for room in house.rooms], axis=0)
    assert indoors[floor].all()
    # A point-like base is clear exactly on the floor, apart from the table.
    off_table = np.abs(local - [1.2, 1.0]).max(1) > 0.4
    few = rng.choice(np.flatnonzero(clear & off_table), 200)
    heights = np.full(200, 0.5, np.float32)
    found = base_clearance_m(
        xy_m[few].astype(np.float32), heights, heights, np.full(200, 1e-3), HouseObstacles(house), 1e-3
    )
    np.testing.assert_array_equal(found >= 0, floor[few])


def test_a_mark_at_the_beginning_is_no_part_of_a_list_of_supports(tmp_path: Path) -> None:
    house = load(tmp_path / "a", room_cells(), f"\ufeffoccupied_height_m = 2.4\n{TABLE}")
    assert len(house.surfaces) == 1


def test_supports_off_the_floor_are_counted_and_mostly_such_are_refused(tmp_path: Path) -> None:
    away = TABLE.replace("[2.5, 2.0]", "[12.5, 2.0]")
    narrow = TABLE.replace("[1.4, 0.8]", "[1.4, 0.2]")
    house = load(tmp_path / "a", room_cells(), f"occupied_height_m = 2.4\n{TABLE}{narrow}{away}")
    assert house.findings == {"implausible (supports off the floor)": 1, "supports without 0.3 x 0.3 m": 1}
    with pytest.raises(InputError, match=r"lab\.toml: support: implausible: 2 of 3 supports.*map's frame"):
        load(tmp_path / "b", room_cells(), f"occupied_height_m = 2.4\n{TABLE}{away}{away}")


@pytest.mark.parametrize(
    ("toml", "named"),
    [
        ("", r"\$: has no key 'support'"),
        ("occupied_height_m = 2.4\nsupport = []", r"\$\.support: lists no support"),
        (f"{TABLE}", r"\$: has no key 'occupied_height_m'"),
        (f"occupied_height_m = nan\n{TABLE}", r"occupied_height_m: nan"),
        (f"walls = 2\n{TABLE}", "unknown key 'walls'"),
        ("occupied_height_m = ", "is not TOML"),
        (
            f"occupied_height_m = 2.4\n{TABLE}height = 1",
            r"support\[0\]: has the unknown key 'height'.*height_m",
        ),
        (f"occupied_height_m = 2.4\n{TABLE}polygon_m = []", "has two outlines"),
        (
            f"occupied_height_m = 2.4\n{COUNTER.replace('[0.1, 3.9]', '[0.1, 3.9, 1]')}",
            "more than the 2 allowed",
        ),
        (
            f"occupied_height_m = 2.4\n{COUNTER.replace('[3.0, 3.9], [0.1, 3.9]', '[1.0, 3.9], [2.0, 3.0]')}",
            "cross",
        ),
        (f"occupied_height_m = 2.4\n{TABLE.replace('0.74', '74')}", r"support\[0\]\.height_m: 74"),
        (
            f"occupied_height_m = 2.4\n{TABLE.replace('size_m', 'yaw_deg')}",
            r"support\[0\]\.yaw_deg: is a list",
        ),
    ],
)
def test_a_bad_list_of_supports_is_named(tmp_path: Path, toml: str, named: str) -> None:
    with pytest.raises(InputError, match=rf"lab\.toml.*({named})"):
        load(tmp_path, room_cells(), toml)


def test_maps_without_floor_walls_or_supports_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for cells, named in (
        (np.full((9, 9), OCCUPIED), "no free cells"),
        (np.full((9, 9), FREE), "no occupied cells"),
        (np.eye(9) * OCCUPIED, "no free area of 1 m2"),
    ):
        with pytest.raises(InputError, match=named):
            load(tmp_path, cells.astype(np.int8))
    (tmp_path / "lab.toml").unlink()
    for place in (tmp_path / "lab.yaml", tmp_path):
        assert cli.run(["submit", "heuristic", "--n", "9", "--houses", f"map:{place}", "--out", "x"]) == 2
        assert "ROOM.toml" in capsys.readouterr().err
    with pytest.raises(InputError, match=r"ROOM\.yaml"):
        open_houses("map:")


def test_a_folder_holds_several_rooms_and_its_digest_follows_their_content(tmp_path: Path) -> None:
    write_map(tmp_path, room_cells(), name="lab")
    write_map(tmp_path, room_cells(), name="office")
    (tmp_path / "cameras.yaml").write_text("image: none")
    first = open_houses(f"map:{tmp_path}")
    assert first.house_ids() == ["lab", "office"]
    (tmp_path / "office.toml").write_text(TOML.replace("0.74", "0.75"))
    second = open_houses(f"map:{tmp_path}")
    assert second.digest != first.digest
    assert second.load("lab").digest == first.load("lab").digest
    (tmp_path / "office.pgm").unlink()
    damaged = open_houses(f"map:{tmp_path}")
    damaged.load("lab")
    with pytest.raises(InputError, match=r"office\.pgm"):
        damaged.load("office")


def test_labels_are_made_in_a_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_map(tmp_path / "maps", room_cells())
    words = ["--n", "60", "--candidates-per-scene", "30", "--workers", "0", "--out", str(tmp_path / "run")]
    assert cli.run(["submit", "heuristic", "--houses", f"map:{path}", *words]) == 0
    assert cli.run(["assets", "check", str(path.parent)]) == 0
    assert "map:" in (out := capsys.readouterr().out) and "1 read" in out


def test_a_map_beyond_the_limits_or_with_an_odd_name_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_map(tmp_path / "odd", room_cells(), name="a\tb")
    with pytest.raises(InputError, match="unprintable"):
        open_houses(f"map:{tmp_path / 'odd'}")
    monkeypatch.setattr("datagen.workers.houses.map_rooms._MAX_SOLIDS", 20)
    with pytest.raises(InputError, match=r"lab\.yaml: image: needs more than 20 boxes"):
        load(tmp_path, room_cells())
    monkeypatch.setattr("datagen.workers.houses.map_rooms._MAX_CELLS", 1000)
    with pytest.raises(InputError, match=r"lab\.yaml: image: has 8,736 cells, more than 1,000"):
        load(tmp_path, room_cells())

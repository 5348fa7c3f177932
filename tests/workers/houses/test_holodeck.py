"""Scenes of Holodeck, without and with the sizes of objathor's annotations."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen import cli
from datagen.schemas.errors import InputError
from datagen.workers.furniture.asset_geometry import type_of_name
from datagen.workers.houses import open_houses
from datagen.workers.houses.house import House
from tests.workers.houses.holodeck_files import TABLE, annotations, piece, scene, write_scene
from tests.workers.houses.house_checks import check_house, covers, top_below_m

ID = "a_dining_room-2024-08-07/a_dining_room"


def load(folder: Path) -> House:
    source = open_houses(f"procthor:{folder}")
    assert source.house_ids() == [ID]
    house = source.load(ID)
    check_house(house)
    return house


def test_furniture_has_the_sizes_that_the_scene_states(tmp_path: Path) -> None:
    house = load(write_scene(tmp_path, scene()))
    furniture = [b for b in house.bodies if b.kind != "wall"]
    assert [b.object_type for b in furniture] == ["DiningTable", "Sofa"]
    assert house.findings == {"unknown assets": 2}  # the picture and the plate
    (table,) = house.surfaces
    assert table.height_m == pytest.approx(0.74)
    assert table.size_m == pytest.approx((1.6, 0.9))
    np.testing.assert_allclose(np.ptp(furniture[0].visual.vertices_m, axis=0), [0.9, 1.6, 0.74], atol=1e-5)
    np.testing.assert_allclose(top_below_m(house, table.surface_id), 0, atol=1e-6)
    walls = [b for b in house.bodies if b.object_type == "Wall"]
    assert len(walls) == 4
    assert any(covers(w, (0.0, 0.5), 1.5) for w in walls)
    assert not any(covers(w, (0.0, 1.5), 1.5) for w in walls)  # the window


def test_annotations_give_the_sizes_of_the_others(tmp_path: Path) -> None:
    plain = load(write_scene(tmp_path, scene()))
    (tmp_path / "annotations.json.gz").write_bytes(gzip.compress(json.dumps(annotations()).encode()))
    house = load(tmp_path)
    assert not house.findings
    furniture = [b for b in house.bodies if b.kind != "wall"]
    assert [b.object_type for b in furniture] == ["Table", "Plate", "Sofa", "Painting"]
    assert [b.kind for b in furniture] == ["furniture", "small", "furniture", "furniture"]
    assert furniture[1].visual.vertices_m[:, 2].min() == pytest.approx(0.74, abs=1e-4)
    assert [s.height_m for s in house.surfaces] == pytest.approx([s.height_m for s in plain.surfaces])


@settings(max_examples=30)
@given(st.floats(0.3, 2.0), st.floats(0.3, 1.5), st.floats(0.3, 1.2), st.sampled_from([0, 90, 180, 270]))
def test_any_piece_has_its_own_size_and_place(
    tmp_path_factory: pytest.TempPathFactory, x: float, y: float, z: float, yaw: int
) -> None:
    document = scene()
    document["objects"] = document["floor_objects"] = [piece("side table-3", TABLE, (x, y, z), (3, 2), yaw)]
    house = load(write_scene(tmp_path_factory.mktemp("scene"), document))
    (body,) = [b for b in house.bodies if b.kind == "furniture"]
    low, high = body.visual.vertices_m.min(0), body.visual.vertices_m.max(0)
    expected = (z, x, y) if yaw % 180 else (x, z, y)
    np.testing.assert_allclose(high - low, expected, atol=1e-4)
    np.testing.assert_allclose((low + high)[:2] / 2, [3, 2], atol=1e-4)
    assert house.surfaces[0].object_type == "SideTable"


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("oak coffee table", "CoffeeTable"),
        ("bookshelf", "ShelvingUnit"),
        ("table lamp", "DeskLamp"),
        ("TV stand", "TVStand"),
        ("ArmChair", "ArmChair"),
        ("rug", "Object"),
        ("", "Object"),
    ],
)
def test_the_last_words_of_a_name_are_the_type(name: str, kind: str) -> None:
    assert type_of_name(name) == kind


def no_vertices(document: dict) -> None:
    document["objects"][0]["vertices"] = [[0, 0], [1]]


def tiny(document: dict) -> None:
    document["objects"][0]["vertices"] = [[0, 0], [10, 0], [10, 10]]


def huge(document: dict) -> None:
    document["objects"][0]["vertices"][0][0] = 1e300


def no_floor_objects(document: dict) -> None:
    document["floor_objects"] = {}


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (no_vertices, r"\$\.objects\[0\]\.vertices\[1\]: has 1 numbers, not 2"),
        (tiny, r"\$\.objects\[0\]\.vertices: is of a piece of 0 x 0 x 0\.74 m"),
        (huge, r"\$\.objects\[0\]\.vertices\[0\]\[0\]: 1e\+300"),
        (no_floor_objects, r"\$\.floor_objects: is an object, not a list"),
    ],
)
def test_bad_scenes_are_named(tmp_path: Path, spoil: Callable[[dict], None], named: str) -> None:
    document = scene()
    spoil(document)
    with pytest.raises(InputError, match=rf"a_dining_room\.json.*{named}"):
        load(write_scene(tmp_path, document))


def test_bad_annotations_are_named(tmp_path: Path) -> None:
    write_scene(tmp_path, scene())
    table = tmp_path / "annotations.json.gz"
    table.write_bytes(gzip.compress(b"{}")[:-4])
    with pytest.raises(InputError, match=r"annotations\.json\.gz: is not a whole gzip file"):
        load(tmp_path)
    entries = annotations()
    del entries[TABLE]["thor_metadata"]["assetMetadata"]["boundingBox"]["max"]
    table.write_bytes(gzip.compress(json.dumps(entries).encode()))
    with pytest.raises(
        InputError, match=rf"annotations\.json\.gz: \$\.{TABLE}.*boundingBox: has no key 'max'"
    ):
        load(tmp_path)


def test_labels_are_made_in_a_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_scene(tmp_path / "scenes", scene())
    words = ["--n", "60", "--candidates-per-scene", "30", "--workers", "0", "--out", str(tmp_path / "run")]
    assert cli.run(["submit", "heuristic", "--houses", f"procthor:{folder}", *words]) == 0
    assert cli.run(["assets", "check", str(folder)]) == 0
    assert "1 read; in the others unknown assets 2" in capsys.readouterr().out
    (folder / "a_dining_room-2024-08-07/a_dining_room.json").write_text("{}")
    assert cli.run(["submit", "heuristic", "--houses", f"procthor:{folder}", *words[:-1], "x"]) == 2
    assert "*.json file with houses" in capsys.readouterr().err

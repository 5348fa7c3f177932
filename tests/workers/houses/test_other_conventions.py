"""Houses whose files follow other conventions: read as they are meant, or refused with the cause."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.schemas.errors import InputError
from datagen.workers.houses import open_houses
from datagen.workers.houses.house import House
from datagen.workers.houses.loader import read_house
from datagen.workers.houses.plausibility import MOST_IMPLAUSIBLE
from datagen.workers.houses.procthor import ProcthorHouses
from tests.workers.houses.house_checks import check_house
from tests.workers.houses.house_files import thing, two_rooms, write_houses, xyz

House_ = dict[str, Any]


def load(folder: Path, document: House_) -> House:
    source = open_houses(f"procthor:{write_houses(folder, [document])}")
    house = source.load("two-rooms")
    check_house(house)
    return house


@pytest.mark.parametrize("order", [(0, 2, 3, 1), (2, 3, 0, 1), (2, 0, 1, 3)])
def test_the_ends_of_a_wall_are_its_lower_corners_wherever_they_are_listed(
    order: tuple[int, ...], tmp_path: Path
):
    """Holodeck lists [p0 floor, p0 ceiling, p1 ceiling, p1 floor], some ProcTHOR houses the ceiling first."""
    usual, other = two_rooms(), two_rooms()
    for wall in other["walls"]:
        wall["polygon"] = [wall["polygon"][k] for k in order]
    ours, theirs = load(tmp_path / "a", usual), load(tmp_path / "b", other)
    assert [b.body_id for b in ours.bodies] == [b.body_id for b in theirs.bodies]
    for a, b in zip(ours.bodies, theirs.bodies, strict=True):
        np.testing.assert_array_equal(a.visual.vertices_m, b.visual.vertices_m)


def flatten_walls(document: House_, count: int) -> None:
    for wall in document["walls"][:count]:
        for corner in wall["polygon"]:
            corner["x"], corner["z"] = 1.0, 1.0


def test_walls_without_length_are_counted_and_a_house_of_mostly_such_is_refused(tmp_path: Path):
    document = two_rooms()
    flatten_walls(document, 3)
    assert load(tmp_path / "a", document).findings == {"walls without length": 3}
    flatten_walls(document, 6)
    with pytest.raises(InputError, match=r"\$\.walls: walls without length: 6 of 10"):
        load(tmp_path / "b", document)


def test_a_second_floor_is_refused_by_version_and_by_height(tmp_path: Path):
    document = two_rooms() | {"metadata": {"schema": "2.0.0"}}
    with pytest.raises(InputError, match=r"\$\.metadata\.schema: .*'2\.0\.0'"):
        load(tmp_path / "a", document)
    load(tmp_path / "b", two_rooms() | {"metadata": {"schema": "1.0.0"}})
    upstairs, raised = two_rooms(), two_rooms()
    for corner in upstairs["rooms"][1]["floorPolygon"]:
        corner["y"] = 3.0
    with pytest.raises(InputError, match=r"\$\.rooms\[1\]\.floorPolygon: another floor: it lies at 3 m"):
        load(tmp_path / "c", upstairs)
    for corner in raised["walls"][4]["polygon"]:
        corner["y"] += 3.0
    with pytest.raises(InputError, match=r"\$\.walls\[4\]\.polygon: another floor: a wall begins at 3 m"):
        load(tmp_path / "d", raised)


def mug(name: str, x: float, z: float) -> House_:
    """A mug on a table."""
    return thing(name, "Mug_1", xyz(x, 0.81, z))


def furnished() -> House_:
    """Two rooms with ten plausible things, of which a few may be moved."""
    document = two_rooms()
    document["objects"] = [
        thing("0|counter", "Table_1", xyz(0.7, 0.375, 0.5), children=[mug("0|mug", 0.7, 0.5)]),
        thing("0|fridge", "Fridge_1", xyz(3.4, 0.9, 2.5)),
        thing("0|chair", "Chair_1", xyz(2.0, 0.45, 0.4)),
        thing("1|table", "Table_1", xyz(6.0, 0.375, 1.5), children=[mug("1|mug", 6.0, 1.5)]),
        thing("1|chair", "Chair_1", xyz(6.0, 0.45, 2.0)),  # pushed below the table
        thing("1|fridge", "Fridge_1", xyz(7.4, 0.9, 2.6)),
    ]  # fmt: skip
    return document


def by_base(document: House_) -> None:
    for furniture in document["objects"]:
        furniture["position"]["y"] = 0.0


def lifted_children(document: House_) -> None:
    for furniture in document["objects"]:
        for child in furniture.get("children", ()):
            child["position"]["y"] += 0.3


def lifted_tables(document: House_) -> None:
    for k in (0, 3):
        document["objects"][k]["position"]["y"] += 0.5


def through_a_wall(document: House_) -> None:
    for k in (0, 1):
        document["objects"][k]["position"]["x"] = -1.5


def overlapping(document: House_) -> None:
    document["objects"][1]["position"] = xyz(0.7, 0.9, 0.6)
    document["objects"][5]["position"] = xyz(6.0, 0.9, 1.4)


def doors_to_no_wall(document: House_) -> None:
    for door in document["doors"]:
        door["wall0"] = door["wall1"] = "w|9"


IMPLAUSIBLE: dict[str, tuple[Callable[[House_], None], str]] = {
    "positions name the base": (by_base, "sunk 6"),
    "children above their table": (lifted_children, "floating 2"),
    "tables in the air": (lifted_tables, "floating 2"),
    "furniture through a wall": (through_a_wall, "outside its room 2"),
    "overlaps": (overlapping, "overlapping 2"),
    "doors to no wall": (doors_to_no_wall, "doors to no wall 2"),
}


@pytest.mark.parametrize("case", IMPLAUSIBLE)
def test_a_house_of_mostly_implausible_things_is_refused_with_the_counts(case: str, tmp_path: Path):
    spoil, counts = IMPLAUSIBLE[case]
    assert not load(tmp_path / "good", furnished()).findings
    document = furnished()
    spoil(document)
    with pytest.raises(InputError, match=rf"two-rooms\): \$: implausible: .*{counts}"):
        load(tmp_path / "bad", document)


def test_a_few_implausible_things_are_counted(tmp_path: Path):
    document = furnished()
    for number in range(2):  # pad with plausible things, so that one is less than the share
        document["objects"][0]["children"] += [
            mug(f"{number}|m{k}", 0.3 + 0.1 * k, 0.3 + 0.2 * number) for k in range(8)
        ]
    document["objects"][3]["children"][0]["position"]["y"] += 0.3
    assert load(tmp_path, document).findings == {"implausible (floating)": 1}


@pytest.mark.parametrize("step", [8, pytest.param(1, marks=pytest.mark.slow)])
def test_no_real_house_is_implausible(step: int, assets: Path):
    """Every eighth house, or all 2018 in ten seconds."""
    source = open_houses(f"procthor:{assets / 'procthor'}")
    assert isinstance(source, ProcthorHouses)
    worst = 0.0
    for house_id in source.house_ids()[::step]:
        record = read_house(source.document(house_id)[0], source.assets)  # raises beyond the share
        number = sum(n for cause, n in record.findings.items() if cause.startswith("implausible"))
        worst = max(worst, number / (len(record.things) + len(record.holes)))
    assert worst < MOST_IMPLAUSIBLE / 2

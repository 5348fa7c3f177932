"""Hostile and broken input: one line that names file, house and field, and never a traceback."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.schemas.errors import InputError
from datagen.workers.furniture.assets import Asset
from datagen.workers.houses import open_houses, things
from datagen.workers.houses.loader import build_house
from datagen.workers.json_document import JsonNode
from tests.workers.houses.house_files import SIZES, thing, two_rooms, write_houses, xyz

NAN, INFINITY = float("nan"), float("inf")


def put(*path: Any, value: Any) -> Callable[[dict], None]:
    """A change of the document at a path."""

    def change(document: dict) -> None:
        for key in path[:-1]:
            document = document[key]
        document[path[-1]] = value

    return change


def drop(*path: Any) -> Callable[[dict], None]:
    def change(document: dict) -> None:
        for key in path[:-1]:
            document = document[key]
        del document[path[-1]]

    return change


BOW_TIE = [xyz(0, 0, 0), xyz(4, 0, 3), xyz(4, 0, 0), xyz(0, 0, 3)]
LINE = [xyz(0, 0, 0), xyz(1, 0, 0), xyz(2, 0, 0)]

# (what is changed, what the message must name)
BROKEN: dict[str, tuple[Callable[[dict], None], str]] = {
    "no rooms": (put("rooms", value=[]), "$.rooms: has no rooms"),
    "rooms missing": (drop("rooms"), "has no key 'rooms'"),
    "rooms an object": (put("rooms", value={}), "$.rooms: is an object, not a list"),
    "too many rooms": (put("rooms", value=[{}] * 300), "$.rooms: has 300 entries"),
    "room id twice": (put("rooms", 1, "id", value="room|0"), "$.rooms[1].id"),
    "floor on a line": (put("rooms", 0, "floorPolygon", value=LINE), "$.rooms[0].floorPolygon"),
    "floor crosses itself": (put("rooms", 0, "floorPolygon", value=BOW_TIE), "$.rooms[0].floorPolygon"),
    "floor with 100 corners": (put("rooms", 0, "floorPolygon", value=LINE * 34), "102 entries"),
    "floor corner NaN": (put("rooms", 0, "floorPolygon", 0, "x", value=NAN), "floorPolygon[0].x: nan"),
    "wall with 3 corners": (drop("walls", 0, "polygon", 3), "$.walls[0].polygon: has 3 corners"),
    "wall without height": (put("walls", 0, "polygon", value=[xyz(0, 0, 0)] * 4), "$.walls[0].polygon"),
    "wall of 100 m": (put("walls", 0, "polygon", 2, "y", value=100), "$.walls[0].polygon: a wall 100 m"),
    "wall colour 300": (put("walls", 0, "material", "color", "r", value=300), "color.r: 300"),
    "hole without area": (put("doors", 0, "holePolygon", value=[xyz(1, 0, 0)] * 2), "$.doors[0].holePolygon"),
    "hole past the wall": (
        put("doors", 0, "holePolygon", value=[xyz(9, 0, 0), xyz(10, 2, 0)]), "$.doors[0].holePolygon"),
    "object id twice": (put("objects", 0, "children", 0, "id", value="0|table"), "children[0].id"),
    "object position missing": (drop("objects", 0, "position"), "$.objects[0]: has no key 'position'"),
    "object true": (put("objects", 0, "position", "x", value=True), "position.x: is a boolean"),
    "object far": (put("objects", 0, "position", "x", value=-1e30), "position.x: -1e+30"),
    "object huge integer": (put("objects", 0, "position", "x", value=10**400), "position.x: a huge number"),
    "id of 10,000 letters": (put("objects", 0, "id", value="x" * 10_000), "$.objects[0].id"),
    "too many objects": (put("objects", value=[0] * 6000), "$.objects: has 6000 entries"),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_house_is_named_and_does_not_hide_the_others(tmp_path: Path, case: str):
    change, named = BROKEN[case]
    good, bad = two_rooms(), two_rooms()
    bad["_id"] = "bad-house"
    change(bad)
    source = open_houses(f"procthor:{write_houses(tmp_path, [good, bad])}")
    assert source.house_ids() == ["bad-house", "two-rooms"]
    with pytest.raises(InputError) as caught:
        source.load("bad-house")
    message = str(caught.value)
    assert "houses.jsonl.gz:2 (bad-house)" in message
    assert named in message
    assert "\n" not in message and len(message) < 1000
    assert source.load("two-rooms").rooms


LINES: dict[str, tuple[bytes, str]] = {
    "not JSON": (b"{rooms: 1}", "not JSON"),
    "cut off": (json.dumps(two_rooms()).encode()[25:500], "not JSON"),
    "nested 100,000 deep": (b"[" * 100_000, "nested too deeply"),
    "not UTF-8": (b'{"rooms": "\xff\xfe"}', "not UTF-8"),
    "a number": (b"12", "a number, not an object"),
    "a number of 10,000 digits": (b'{"rooms": ' + b"9" * 10_000 + b"}", "too many digits"),
}


@pytest.mark.parametrize("case", LINES)
def test_a_line_that_is_no_house_is_named(tmp_path: Path, case: str):
    line, named = LINES[case]
    source = open_houses(f"procthor:{write_houses(tmp_path, [two_rooms(), line])}")
    assert len(source.house_ids()) == 2
    broken = next(i for i in source.house_ids() if i != "two-rooms")
    with pytest.raises(InputError, match=named) as caught:
        source.load(broken)
    assert "houses.jsonl.gz:2" in str(caught.value)


TABLES: dict[str, tuple[Any, str]] = {
    "a number": (5, "neither an object of assets"),
    "no size": ({"A": {"objectType": "Bed"}}, "$.A: has no key 'size'"),
    "two sides": ({"A": {"objectType": "Bed", "size": [1, 2]}}, "2 numbers"),
    "negative side": ({"A": {"objectType": "Bed", "size": [1, -2, 1]}}, "-2 is not within"),
    "NaN side": ({"A": {"objectType": "Bed", "size": [1, NAN, 1]}}, "nan is not within"),
    "NaN rest height": ({"A": {"objectType": "Bed", "size": [1, 1, 1], "surface_height_m": NAN}}, "nan"),
    "type missing": ({"A": {"size": [1, 1, 1]}}, "key 'objectType'"),
}


@pytest.mark.parametrize("case", TABLES)
def test_a_broken_size_table_is_refused_at_opening(tmp_path: Path, case: str):
    sizes, named = TABLES[case]
    write_houses(tmp_path, [two_rooms()], sizes)
    with pytest.raises(InputError, match=r"asset_sizes\.json") as caught:
        open_houses(f"procthor:{tmp_path}")
    assert named in str(caught.value)


def test_folders_and_references_without_houses(tmp_path: Path):
    for ref in ("castle", "", "procthor", "procthor:/no/such/folder", f"procthor:{tmp_path}", "ai2thor:/no"):
        with pytest.raises(InputError):
            open_houses(ref)
    with pytest.raises(InputError, match="ai2thor, builtin, habitat, map, procthor"):
        open_houses("castle:x")
    for ref in ("builtin:0", "builtin:-1", "builtin:many", "builtin:99999999"):
        with pytest.raises(InputError, match="not a number"):
            open_houses(ref)
    write_houses(tmp_path, [two_rooms()], sizes=None)
    with pytest.raises(InputError, match="has no size table"):
        open_houses(f"procthor:{tmp_path}")
    write_houses(tmp_path, [])
    with pytest.raises(InputError, match="without houses"):
        open_houses(f"procthor:{tmp_path}")
    (tmp_path / "houses.jsonl.gz").unlink()
    with pytest.raises(InputError, match="file with houses"):
        open_houses(f"procthor:{tmp_path}")


@pytest.mark.parametrize("damage", ["truncated", "not gzip", "flipped"])
def test_damaged_archives_are_named(tmp_path: Path, damage: str):
    path = write_houses(tmp_path, [two_rooms()]) / "houses.jsonl.gz"
    data = path.read_bytes()
    flipped = data[:60] + bytes(255 - b for b in data[60:90]) + data[90:]
    damaged = {"truncated": data[: len(data) // 2], "not gzip": b"PK" + data, "flipped": flipped}
    path.write_bytes(damaged[damage])
    with pytest.raises(InputError, match=r"houses\.jsonl\.gz"):
        open_houses(f"procthor:{tmp_path}")


def test_two_different_houses_with_one_id_are_refused_by_that_id(tmp_path: Path):
    other = two_rooms()
    other["objects"] = []
    source = open_houses(f"procthor:{write_houses(tmp_path, [two_rooms(), other, two_rooms()])}")
    assert source.house_ids() == ["two-rooms"]
    with pytest.raises(InputError, match=r"two houses: houses\.jsonl\.gz:1 and houses\.jsonl\.gz:2"):
        source.load("two-rooms")
    with pytest.raises(InputError, match="no house 'x'"):
        source.load("x")


def test_a_house_of_more_things_than_memory_would_bear(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(things, "MAX_BODIES", 50)
    document = two_rooms()
    document["objects"] = [thing(f"0|{k}", "Mug_1", xyz(1, 0.05, 1)) for k in range(60)]
    source = open_houses(f"procthor:{write_houses(tmp_path, [document])}")
    with pytest.raises(InputError, match=r"objects\[50\]: has more than 50 objects"):
        source.load("two-rooms")


ASSETS = {
    k: Asset(k, v["objectType"], (v["size"][0], max(v["size"][2], 0.01), v["size"][1]))
    for k, v in SIZES.items()
}
WEIRD = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.just([]), st.just({}),
    st.just([1, [2]]), st.just(10**30),
)  # fmt: skip


def paths_of(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    out = [path] if path else []
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        out += paths_of(inner, (*path, key))
    return out


@given(st.data())
@settings(max_examples=300, deadline=None)
def test_any_value_anywhere_gives_a_house_or_an_input_error(data: st.DataObject):
    document = two_rooms()
    document["objects"].append(thing("0|chair", "Chair_1", xyz(1, 0.45, 1)))
    paths = paths_of(document)
    for _ in range(data.draw(st.integers(1, 3))):
        path = data.draw(st.sampled_from(paths))
        try:
            put(*path, value=data.draw(WEIRD))(document)
        except (KeyError, IndexError, TypeError):
            continue  # an earlier change removed what lies on the path
    try:
        house = build_house(JsonNode("file", "$", document), "h", "0" * 64, ASSETS)
    except InputError as error:
        assert str(error).startswith("file: $")
    else:
        assert house.rooms

"""Opening folders: digests, order, caches, splits, and how sources are named."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from datagen.schemas.errors import InputError
from datagen.workers.houses import HOUSE_SOURCES, ids_of_split, open_houses, split_of
from tests.workers.houses.house_files import SIZES, thing, two_rooms, write_houses, xyz

DESK_M, DESK_TOP_M = 1.21037, 0.734


def named(name: str, **more: object) -> dict:
    return {**two_rooms(), "_id": name, **more}


def test_every_source_is_registered_and_its_package_imports_nothing_heavy():
    assert set(HOUSE_SOURCES) == {"builtin", "procthor", "ai2thor", "habitat", "map"}
    heavy = "('scipy', 'trimesh', 'PIL')"
    code = f"import sys, datagen.workers.houses; print(*(m for m in {heavy} if m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_the_digest_is_of_content_not_of_names_or_compression(tmp_path: Path):
    houses = [named("a"), named("b"), named("c")]
    first = open_houses(f"procthor:{write_houses(tmp_path / 'one', houses)}")
    second = open_houses(f"procthor:{write_houses(tmp_path / 'two', houses[::-1], name='x.jsonl')}")
    write_houses(tmp_path / "three", houses[:1], name="train.jsonl.gz")
    write_houses(tmp_path / "three", houses[1:], name="val.jsonl")
    third = open_houses(f"procthor:{tmp_path / 'three'}")
    assert first.digest == second.digest == third.digest
    assert first.house_ids() == second.house_ids() == third.house_ids() == ["a", "b", "c"]
    assert first.load("b").digest == third.load("b").digest
    changed = [*houses[:2], named("c", extra=1)]
    assert open_houses(f"procthor:{write_houses(tmp_path / 'four', changed)}").digest != first.digest
    sizes = {**SIZES, "New_1": {"objectType": "Bed", "size": [1, 1, 1]}}
    assert open_houses(f"procthor:{write_houses(tmp_path / 'five', houses, sizes)}").digest != first.digest


def test_ids_come_from_the_top_level_or_from_file_and_line(tmp_path: Path):
    without = {k: v for k, v in two_rooms().items() if k != "_id"}
    houses = [without, named("real", _source={"_id": "other"})]
    source = open_houses(f"procthor:{write_houses(tmp_path, houses, name='train.jsonl.gz')}")
    assert source.house_ids() == ["real", "train-000001"]


def test_the_original_asset_database_serves_as_well(tmp_path: Path):
    write_houses(tmp_path, [two_rooms()], sizes=None)
    entries: dict[str, list[dict]] = {}
    for asset_id, value in SIZES.items():
        box = dict(zip("xyz", value["size"], strict=True))
        entries.setdefault(value["objectType"], []).append(
            {"assetId": asset_id, "objectType": value["objectType"], "boundingBox": box}
        )
    for table in (entries, [e for group in entries.values() for e in group]):
        (tmp_path / "asset-database.json").write_text(json.dumps(table))
        house = open_houses(f"procthor:{tmp_path}").load("two-rooms")
        assert [s.height_m for s in house.surfaces] == [pytest.approx(0.75)]


def test_things_rest_on_a_desk_of_the_original_database_as_they_were_observed(tmp_path: Path):
    """The hutch of the desk reaches 1.21 m; things stand on its top."""
    house = two_rooms()
    mug = thing("m", "Mug_1", xyz(1.5, 0.9, 1.6))
    house["objects"] = [thing("d", "Desk_305_1", xyz(1.5, DESK_M / 2, 1.5), children=[mug])]
    write_houses(tmp_path, [house], sizes=None)
    sizes = {"Desk_305_1": ("Desk", 1.4, DESK_M, 0.6), "Mug_1": ("Mug", 0.1, 0.1, 0.1)}
    entries = [
        {"assetId": i, "objectType": kind, "boundingBox": dict(zip("xyz", size, strict=True))}
        for i, (kind, *size) in sizes.items()
    ]
    (tmp_path / "asset-database.json").write_text(json.dumps(entries))
    (surface, *_) = open_houses(f"procthor:{tmp_path}").load("two-rooms").surfaces
    assert surface.height_m == pytest.approx(DESK_TOP_M)
    entries[0]["boundingBox"]["y"] = 1.5  # another desk under the same name: nothing is known of it
    house["objects"][0]["position"]["y"] = 0.75
    write_houses(tmp_path, [house], sizes=None)
    (tmp_path / "asset-database.json").write_text(json.dumps(entries))
    (surface, *_) = open_houses(f"procthor:{tmp_path}").load("two-rooms").surfaces
    assert surface.height_m == pytest.approx(1.5)


def test_damaged_packed_houses_are_read_from_the_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("DATAGEN_CACHE", str(tmp_path / "cache"))
    ref = f"procthor:{write_houses(tmp_path / 'houses', [named('a'), named('b')])}"
    before = open_houses(ref)
    (packed,) = (tmp_path / "cache").rglob("*.*")
    good = packed.read_bytes()
    packed.write_bytes(good[:-9])
    assert open_houses(ref).load("b").digest == before.load("b").digest
    assert packed.read_bytes() == good
    bad = bytearray(good)
    bad[60] ^= 1
    packed.write_bytes(bytes(bad))
    damaged = open_houses(ref)
    # The folder still holds the house: a scene must not be drawn elsewhere for a damaged copy.
    assert damaged.load("a").digest == before.load("a").digest
    write_houses(tmp_path / "houses", [named("c"), named("d")])
    with pytest.raises(InputError, match="changed since"):
        damaged.load("a")


def test_without_a_cache_everything_works_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "file").write_text("")
    ref = f"procthor:{write_houses(tmp_path / 'houses', [named('a'), named('b')])}"
    digest = open_houses(ref).digest
    monkeypatch.setenv("DATAGEN_CACHE", str(tmp_path / "file"))
    source = open_houses(ref)
    assert source.digest == digest and source.load("a").rooms


def test_many_open_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("DATAGEN_CACHE", str(tmp_path / "cache"))
    ref = f"procthor:{write_houses(tmp_path / 'houses', [named(f'h{k}') for k in range(20)])}"
    with ThreadPoolExecutor(8) as pool:
        sources = list(pool.map(lambda _: open_houses(ref), range(16)))
    assert len({s.digest for s in sources}) == 1
    assert all(s.load("h7").rooms for s in sources)
    assert len(list((tmp_path / "cache").rglob("*.*"))) == 1  # no leftovers


def test_splits_are_disjoint_complete_and_near_80_10_10():
    source = open_houses("builtin:2000")
    parts = [ids_of_split(source, s) for s in ("train", "val", "test")]
    ids = sorted(source.house_ids())
    assert sorted(itertools.chain(*parts)) == ids == sorted(ids_of_split(source, "all"))
    shares = np.array([len(p) for p in parts]) / 2000
    np.testing.assert_allclose(shares, [0.8, 0.1, 0.1], atol=0.03)
    # Houses of finished runs: these must never move.
    held_out = [k for k in range(40) if split_of(f"builtin-{k:04d}") != "train"]
    assert held_out == [1, 4, 6, 8, 9, 18, 19, 24, 25, 27, 29, 36, 37]

"""What `submit` says of houses and objects that it cannot use."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import datagen
from datagen import cli
from datagen.schemas.run import Run
from tests.refusals import refused
from tests.small_runs import PER_SCENE, submit_arguments
from tests.workers.houses.house_files import thing, two_rooms, write_houses, xyz
from tests.workers.objects.toy_set import write_bundle


def house(name: str, **more: Any) -> dict[str, Any]:
    return two_rooms() | {"_id": name, **more}


def six_houses(folder: Path) -> Path:
    """Two usable ones, which hold unknown assets; a broken one, two sunk ones and one of another schema."""
    objects = two_rooms()["objects"]
    unknown = [thing(f"x{k}", "0a1b", xyz(1, 1, 1)) for k in range(3)]
    sunk = [thing("t", "Table_1", xyz(1.5, 0.0, 2.0))]
    houses = [
        house("good-1", objects=[*objects, *unknown]),
        house("good-2"),
        house("broken", rooms=[]),
        house("sunk-1", objects=sunk),
        house("sunk-2", objects=sunk),
        house("two-floors", metadata={"schema": "2.0.0"}),
    ]
    return write_houses(folder, houses)


def submitted(tmp_path: Path, *more: str) -> list[str]:
    houses = six_houses(tmp_path / "houses")
    objects = write_bundle(tmp_path / "objects", *(f"{k:03d}_cube" for k in range(20)))
    index = json.loads((objects / "objects.json").read_text())
    index[3]["mass_kg"], index[4]["mass_kg"] = 40.0, 0.0001
    (objects / "objects.json").write_text(json.dumps(index))
    sources = ("--houses", f"procthor:{houses}", "--objects", f"ycb:{objects}")
    return submit_arguments(tmp_path / "run", PER_SCENE, *sources, *more)


HOUSES = (
    "6 read, 4 unusable (implausible 2, has no rooms 1, unknown schema 1); in the others unknown assets 3"
)
OBJECTS = "20 read, 2 unusable (wrong density 2)"


def test_unusable_houses_and_objects_are_counted_on_one_line_and_in_the_manifest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(submitted(tmp_path)) == 0
    printed = capsys.readouterr()
    told = printed.err.splitlines()
    assert f"procthor houses: {HOUSES}" in told and f"ycb objects: {OBJECTS}" in told
    assert "2 of 6 procthor houses" in printed.out
    sources = Run.open(tmp_path / "run").manifest.sources
    assert (sources["houses_read"], sources["objects_read"]) == (HOUSES, OBJECTS)
    assert sources["n_houses"] == "2 of 6"


def test_a_dry_run_names_each_with_its_reason(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [*submitted(tmp_path), "--dry-run"]
    for _ in range(2):  # the second reads the cache
        assert cli.run(arguments) == 0
        told = capsys.readouterr().err
        assert "  sunk-1: implausible: 1 of 4 things (sunk 1)" in told
        assert "  two-floors: unknown schema: version '2.0.0', not 1" in told
        assert "houses.jsonl.gz:3 (broken)" in told
        assert "  003_cube: wrong density: " in told
    assert cli.run([*arguments, "--json"]) == 0
    events = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    of = {event["source"]: event for event in events if event["event"] == "source"}
    assert of["procthor houses"]["unusable"] == {"implausible": 2, "has no rooms": 1, "unknown schema": 1}
    assert of["procthor houses"]["findings"] == {"unknown assets": 3}
    assert set(of["ycb objects"]["reasons"]) == {"003_cube", "004_cube"}


def test_scenes_that_are_labelled_again_keep_the_counts(tmp_path: Path) -> None:
    assert cli.run(submitted(tmp_path)) == 0
    again = ["--out", str(tmp_path / "again"), "--scenes-from", str(tmp_path / "run"), "--workers", "0"]
    assert cli.run(["submit", "heuristic", "--n", str(PER_SCENE), *again]) == 0
    known, kept = (dict(Run.open(tmp_path / name).manifest.sources) for name in ("run", "again"))
    assert kept.pop("scenes_from") and kept == known


def test_licences_are_those_that_the_folders_state(tmp_path: Path) -> None:
    arguments = submitted(tmp_path)
    assert cli.run(arguments) == 0
    assert datagen.open_dataset(tmp_path / "run").attrs["license"] == (
        "houses read as procthor: not stated; objects read as ycb: not stated"
    )
    stated = {"title": "Toys", "licence": "CC0-1.0", "attribution": "A. Maker", "more": 1}
    (tmp_path / "objects/source.json").write_text(json.dumps(stated))
    arguments[arguments.index(str(tmp_path / "run"))] = str(tmp_path / "stated")
    assert cli.run(arguments) == 0
    for path in (tmp_path / "stated", tmp_path / "stated/data.zarr"):
        told = datagen.open_dataset(path).attrs
        assert told["license"] == "houses read as procthor: not stated; Toys: CC0-1.0"
        assert told["title"].endswith("in houses read as procthor with Toys")
        assert told["references"] == "A. Maker"


@pytest.mark.parametrize("text", ['{"licence": 1}', "[]", "{", '{"title": "\\u0007"}'])
def test_a_bad_statement_is_named(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = submitted(tmp_path)
    (tmp_path / "houses/source.json").write_text(text)
    refused(arguments, capsys, "houses/source.json")


def test_a_statement_that_links_to_nothing_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = submitted(tmp_path)
    (tmp_path / "houses/source.json").symlink_to(tmp_path / "gone.json")
    refused(arguments, capsys, "houses/source.json")

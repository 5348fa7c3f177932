"""Places that are no run, damaged and hostile runs, and a full disk."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from datagen import cli
from datagen.schemas.record_files import signed_json
from datagen.schemas.run import Run
from tests.made_runs import flip, object_of
from tests.refusals import refused
from tests.small_disk import small_disk
from tests.small_runs import CONFIG, PER_SCENE, files_of, submit_arguments


@pytest.mark.parametrize("verb", ["status", "audit", "show", "verify", "verify --repair", "verify --clean"])
@pytest.mark.parametrize("name", ["missing", "empty", "file", "foreign"])
def test_a_place_that_is_no_run(
    verb: str, name: str, places: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    before = files_of(places["out"].parent)
    more = ["--out", str(places["out"]) + ".png"] if verb == "show" else []
    refused([*verb.split(), str(places[name]), *more], capsys, str(places[name]))
    assert files_of(places["out"].parent) == before and not places["missing"].exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--scene", "3", "--out", "{tmp}/a.png"], ["--scene", "3", "0 to 2"]),
        (["--scene", "-1", "--out", "{tmp}/a.png"], ["--scene", "-1"]),
        (["--scene", "first", "--out", "{tmp}/a.png"], ["--scene", "first"]),
        (["--scene", "9" * 30, "--out", "{tmp}/a.png"], ["--scene"]),
        (["--out", "{tmp}/a.jpg"], ["a.jpg", ".png"]),
        (["--out", "{tmp}/none/a.png"], ["{tmp}/none/a.png", "folder"]),
        (["--houses", "builtin:3", "--out", "{tmp}/a.png"], ["--houses", "builtin"]),
        (["--objects", "ycb:{tmp}", "--out", "{tmp}/a.png"], ["{tmp}"]),
        ([], ["--out"]),
    ],
)
def test_a_bad_picture(
    arguments: list[str], words: list[str], finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    filled = [a.format(tmp=tmp_path) for a in arguments]
    refused(["show", str(finished), *filled], capsys, *(w.format(tmp=tmp_path) for w in words))
    assert list(tmp_path.iterdir()) == []


def _edit(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    record = json.loads(path.read_text())
    del record["sha256"]
    change(record)
    path.write_bytes(signed_json(record))


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def _reseed(path: Path) -> None:
    _edit(path, lambda manifest: manifest["spec"].update(seed=9))


def _lead_outside(path: Path) -> None:
    _edit(path, lambda commit: commit["object"].update(path="../../secret"))


DAMAGE: list[tuple[str, str, Callable[[Path], None], list[str]]] = [
    ("manifest cut", "manifest.json", _cut, []),
    ("specification edited", "manifest.json", _reseed, ["spec_hash"]),
    ("commit cut", "commits/000000.json", _cut, []),
    ("commit with a path that leaves the run", "commits/000000.json", _lead_outside, ["object.path"]),
    (
        "commit of infinite cost", "commits/000000.json",
        lambda p: p.write_text(p.read_text().replace('"wall_s":', '"wall_s":1e999,"was":', 1)) and None, [],
    ),
    ("plan cut", "plans/1.json", _cut, []),
]  # fmt: skip


@pytest.mark.parametrize("verb", ["status", "audit", "submit", "show"])
@pytest.mark.parametrize(("name", "key", "damage", "words"), DAMAGE, ids=[d[0] for d in DAMAGE])
def test_a_damaged_run(
    name: str, key: str, damage: Callable[[Path], None], words: list[str], verb: str, copied: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    if verb == "audit" and key.startswith("plans"):
        verb = "status"  # an audit counts what is there, whatever was planned
    damage(copied / key)
    before = files_of(copied)
    arguments = {
        "submit": submit_arguments(copied, 3 * PER_SCENE),
        "show": ["show", str(copied), "--out", str(copied.parent / "a.png")],
    }
    refused(arguments.get(verb, [verb, str(copied)]), capsys, f"{copied}/{key}", *words)
    assert files_of(copied) == before
    assert not (copied.parent / "a.png").exists()


def test_a_shard_file_that_was_changed(copied: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = object_of(copied, 0)
    flip(file)
    picture = copied.parent / "a.png"
    refused(["show", str(copied), "--out", str(picture)], capsys, str(file))
    assert not picture.exists()


# Disks -------------------------------------------------------------------------------------------


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    """Less than a small run needs."""
    with small_disk(tmp_path / "disk", "96k") as disk:
        yield disk


def test_a_full_disk(tiny_disk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tiny_disk / "run"
    file = tmp_path / "small.toml"
    file.write_text(CONFIG)
    arguments = ["submit", "heuristic", "--n", "128", "--out", str(run), "--candidates-per-scene", "8"]
    assert cli.run([*arguments, "--workers", "0", "--config", str(file), "--json"]) == 2
    told = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("{")]
    assert len(told) == 1 and "No space left on device" in told[0] and "resume" in told[0].lower()
    assert not (run / "data.zarr").exists()
    for commit in Run.open(run).commits():  # what counts is whole
        Run.open(run).read_object(commit)

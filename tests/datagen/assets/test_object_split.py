"""Objects divided into those that models are trained on and those that they never see."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from datagen import cli
from tests.made_runs import files_of
from tests.refusals import refused


def ycb_folder(folder: Path, *, path: str = "{key}/a.obj", n: int = 10, **more: object) -> Path:
    """A folder of `n` objects with a file each, of which the last one names `path`, or has other fields."""
    entries: list[dict[str, object]] = []
    for i in range(n):
        key = f"{i:03}_thing"
        (folder / key).mkdir(parents=True)
        (folder / key / "a.obj").write_text(key)
        last = i == n - 1
        entries.append({"key": key, "files": {"visual": (path if last else "{key}/a.obj").format(key=key)}})
        entries[-1] |= more if last else {}
    (folder / "objects.json").write_text(json.dumps(entries[::-1]))
    return folder


def test_objects_are_split_by_their_names(tmp_path: Path) -> None:
    source, out = ycb_folder(tmp_path / "ycb"), tmp_path / "out"
    (source / "source.json").write_text('{"licence": "CC0-1.0"}')
    assert cli.run(["assets", "split", str(source), str(out)]) == 0
    keys = {
        n: [e["key"] for e in json.loads((out / n / "objects.json").read_text())] for n in ("train", "test")
    }
    assert keys["test"] == ["004_thing", "009_thing"]
    assert sorted(keys["train"] + keys["test"]) == [f"{i:03}_thing" for i in range(10)]
    before = files_of(out)
    assert before["test/009_thing/a.obj"] == b"009_thing" and len(before) == 14
    assert before["train/source.json"] == before["test/source.json"] == b'{"licence": "CC0-1.0"}'
    assert cli.run(["assets", "split", str(source), str(out)]) == 0
    assert files_of(out) == before
    # One of its own results, split again into the place where it lies.
    assert cli.run(["assets", "split", str(out / "train"), str(out)]) == 2
    assert files_of(out) == before


def fetched(folder: Path, *names: str) -> Path:
    """A folder as `assets fetch ycb` leaves it."""
    for name in names:
        (folder / "models" / name / "textures").mkdir(parents=True)
        (folder / "models" / name / "textured.obj").write_text(name)
        (folder / "models" / name / "textures" / "map.png").write_text(name)
    index = {name: {"density": 1000, "scales": [1.0]} for name in names}
    (folder / "info_pick_v0.json").write_text(json.dumps(index))
    return folder


def test_a_fetched_folder_is_split_in_its_own_layout(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = [f"{k:03}_thing" for k in range(6)]
    source, out = fetched(tmp_path / "mani_skill2_ycb", *names), tmp_path / "out"
    assert cli.run(["assets", "split", str(source), str(out)]) == 0
    held_out, kept = (json.loads((out / n / "info_pick_v0.json").read_text()) for n in ("test", "train"))
    assert list(held_out) == ["004_thing"] and sorted(held_out | kept) == names
    assert held_out["004_thing"] == {"density": 1000, "scales": [1.0]}
    files = files_of(out)
    assert files["test/models/004_thing/textures/map.png"] == b"004_thing" and len(files) == 2 * 6 + 2
    for wrong in ("../secret", "gone"):
        (source / "info_pick_v0.json").write_text(json.dumps({name: {} for name in [*names, wrong]}))
        refused(["assets", "split", str(source), str(tmp_path / "other")], capsys, wrong, "has no folder")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"path": "../secret"}, "[0].files"),
        ({"path": "{key}/../../secret"}, "[0].files"),
        ({"path": "link"}, "[0].files"),
        ({"path": "/etc/hostname"}, "[0].files"),
        ({"path": "{key}/none.obj"}, "[0].files"),
        ({"path": "a\0b"}, "[0].files"),
        ({"key": "000_thing"}, "].key"),
        ({"key": 3}, "[0].key"),
        ({"files": ["a"]}, "[0].files"),
        ({"n": 4}, "5 objects"),
    ],
)
def test_an_index_that_leads_elsewhere_is_one_line(
    changes: dict[str, Any], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "secret").write_text("secret")
    source = ycb_folder(tmp_path / "ycb", **changes)
    (source / "link").symlink_to(tmp_path / "secret")
    assert cli.run(["assets", "split", str(source), str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"error: {source}/objects.json: ") and words in told and told.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("text", ["", "[", "{}", "[1,2,3,4,5]", "\xff", "[" * 200_000])
def test_a_broken_index_is_one_line(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "objects.json").write_bytes(text.encode("latin-1"))
    assert cli.run(["assets", "split", str(tmp_path), str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert cli.run(["assets", "split", str(tmp_path / "none"), str(tmp_path / "out")]) == 2
    assert not (tmp_path / "out").exists()

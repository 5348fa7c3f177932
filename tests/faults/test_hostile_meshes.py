"""Meshes that are damaged, absurd or huge: refused in one line, or finite. A sample of the campaign."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.faults.hostile_meshes import GLBS, OBJECTS, PLYS, one, put

LARGE = ("000", "instances", "parts", "20,000 times")
USED = ("cube", "tetrahedron")


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        (kind, name)
        for kind, names in (("visual", OBJECTS), ("collision", OBJECTS), ("ply", PLYS), ("glb", GLBS))
        for name in names
        if not any(word in name for word in LARGE)
    ],
)
def test_a_hostile_mesh_is_refused_in_one_line_or_used(
    kind: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DATAGEN_CACHE", str(tmp_path / "cache"))
    code = one(kind, put(tmp_path, kind, name))
    said = capsys.readouterr().out
    assert (code == 2) == bool(said) and len(said.splitlines()) <= 1
    assert code == 0 or name not in USED or kind == "ply", said


def test_a_cone_of_many_corners_is_refused_as_a_part_and_reduced_in_a_house(tmp_path: Path) -> None:
    assert one("collision", put(tmp_path, "collision", "a polygon of 100,000 corners")) == 2
    assert one("glb", put(tmp_path, "glb", "100,000 corners on a circle")) == 0

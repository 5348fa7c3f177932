"""A release is repeatable, complete, and states the version everywhere."""

from __future__ import annotations

import re
from hashlib import sha256
from pathlib import Path

import pytest

import datagen
from scripts import release
from tests.conftest import REPOSITORY


def test_the_citation_is_of_this_version() -> None:
    cited = (REPOSITORY / "CITATION.cff").read_text("utf-8")
    dated = re.search(
        rf"^## \[{re.escape(datagen.__version__)}\] - (\S+)$", (REPOSITORY / "CHANGELOG.md").read_text(), re.M
    )
    assert dated is not None
    assert f"version: {datagen.__version__}\ndate-released: {dated[1]}\n" in cited


@pytest.mark.slow
def test_a_release_made_twice_has_equal_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DATAGEN_ASSETS", raising=False)
    for name in ("first", "second"):
        release.make_release(tmp_path / name, {"heuristic": 120, "plan": 40})
    first, second = ((tmp_path / name / "SHA256SUMS").read_text("utf-8") for name in ("first", "second"))
    assert first == second
    listed = dict(reversed(line.split("  ")) for line in first.splitlines())
    for name, digest in listed.items():
        assert sha256((tmp_path / "first" / name).read_bytes()).hexdigest() == digest
    assert {path.split("/")[0] for path in listed} == {"UPLOAD.md", "benchmark", "dist", "labels", "model"}
    assert sum(path.endswith((".whl", ".tar.gz")) for path in listed) == 2

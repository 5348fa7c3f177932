"""Fixtures of the command line's tests."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def places(tmp_path: Path) -> dict[str, Path]:
    """Folders and files that arguments name in braces."""
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("text")
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.tex").write_text("text")
    names = ("out", "empty", "file", "foreign", "missing")
    return {name: tmp_path / name for name in names}

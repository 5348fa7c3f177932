"""Fixtures of the command line's tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults.damage_campaign import copy_run
from tests.small_runs import PER_SCENE, make_small_run


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three scenes in as many shards. Tests only read it."""
    return make_small_run(tmp_path_factory.mktemp("finished") / "run", 3 * PER_SCENE)


@pytest.fixture
def copied(finished: Path, tmp_path: Path) -> Path:
    """The finished run, or the one of that name in the test's file, to be changed; its links are kept."""
    copy_run(finished, tmp_path / "run")
    return tmp_path / "run"


@pytest.fixture
def places(tmp_path: Path) -> dict[str, Path]:
    """Folders and files that arguments name in braces."""
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("text")
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.tex").write_text("text")
    names = ("out", "empty", "file", "foreign", "missing")
    return {name: tmp_path / name for name in names}

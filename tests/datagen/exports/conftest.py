"""Runs that are exported."""

from __future__ import annotations

from pathlib import Path

import pytest

from datagen import cli
from tests.conftest import once
from tests.small_runs import PER_SCENE, make_small_run
from tests.train.conftest import sim_run

__all__ = ["sim_run"]

SCENES = 7


@pytest.fixture(scope="module")
def run(shared_folder: Path) -> Path:
    """Seven scenes, some in houses of validation; the last is cut to half of its candidates."""
    out = shared_folder / "exported"
    n = SCENES * PER_SCENE - PER_SCENE // 2
    return once(out, lambda: make_small_run(out, n, "--houses", "builtin:12"))


def export(run: Path, to: str, out: Path, *more: str) -> Path:
    assert cli.run(["export", str(run), "--to", to, "--out", str(out), *more]) == 0
    return out

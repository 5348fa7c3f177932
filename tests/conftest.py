"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def assets() -> Path:
    """The folder of real houses and objects, or a skip that says how to have one."""
    folder = Path(os.environ.get("DATAGEN_ASSETS") or REPOSITORY.parent / "shared" / "assets")
    if not (folder / "ycb" / "objects.json").is_file():
        pytest.skip(f"no real assets at {folder}: set DATAGEN_ASSETS to a folder with ycb/ and procthor/")
    return folder

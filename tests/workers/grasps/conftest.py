"""Grasps are kept in memory and on disk: every test begins with neither."""

from __future__ import annotations

from pathlib import Path

import pytest

import datagen.workers.grasps.grasp_cache


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A fresh cache folder, and nothing in memory."""
    monkeypatch.setenv("DATAGEN_CACHE", str(tmp_path / "cache"))
    datagen.workers.grasps.grasp_cache._kept.clear()
    return tmp_path / "cache"

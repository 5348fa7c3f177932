"""Opening a world: what the first worker of a machine worked out serves those after it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from datagen.workers.houses import open_houses
from datagen.workers.objects import open_objects
from datagen.workers.world import World, assemble_world
from tests.made_runs import small_spec
from tests.workers.objects.toy_set import write_bundle


def test_a_second_start_reads_no_object(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = tmp_path / "cache"
    monkeypatch.setenv("DATAGEN_CACHE", str(cache))
    folder = write_bundle(tmp_path / "set", *(f"{k:03d}_cube" for k in range(9)))

    def start() -> World:
        objects = open_objects(f"ycb:{folder}")
        return assemble_world(small_spec(), open_houses("builtin"), objects, "builtin", str(folder))

    first = start()
    shutil.rmtree(cache / "objects")
    second = start()
    assert not (cache / "objects").exists()
    assert second.target_names == first.target_names == first.object_names
    assert second.objects.digest == first.objects.digest
    shutil.rmtree(cache)
    assert start().target_names == first.target_names

"""What a release wrote opens for ever: its run is sound, readers give its rows, and its checkpoint loads."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import datagen
from datagen import cli
from tests.columns import columns_of
from tests.golden.make import GOLDEN, TOLD, held
from tests.small_runs import arrays_of


@pytest.mark.parametrize("version", json.loads(TOLD.read_text()))
def test_files_of_a_release_open_and_hold_what_they_held(version: str, tmp_path: Path) -> None:
    shutil.unpack_archive(GOLDEN / f"{version}.zip", tmp_path)
    run = tmp_path / "run"
    assert held(tmp_path) == json.loads(TOLD.read_text())[version]
    assert cli.run(["verify", str(run)]) == 0
    arrays = arrays_of(run)
    for place in (run, run / "data.zarr"):
        read = columns_of(place)
        np.testing.assert_array_equal(np.concatenate([shard["label"] for shard in read]), arrays["label"])
        assert len(datagen.candidates(place)) == len(arrays["label"])

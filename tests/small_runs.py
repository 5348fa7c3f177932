"""Small real runs on the built-in world, made through the command line as a user makes them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr

from datagen import cli
from datagen.schemas.sealing import store_record
from datagen.schemas.storage import open_storage
from tests.made_runs import files_of as files_of

# Small frames, clouds and windows: everything a full run does, at a fraction of its time.
CONFIG = """
[observation]
n_points = 256
width_px = 160
height_px = 120
fx_px = 154.0
fy_px = 154.0
min_target_points = 16
n_farthest = 64

[visibility]
window_px = 24
"""
# Of plans and trials within reach: no places where parking decides, which take several times as long.
OPEN_TOPS = "[scene]\nplaces = {}\n"
# Of plans on whole grids. Long arms and small grids, so that most grids have good and bad clear cells.
GRID_CONFIG = (
    CONFIG
    + """
[candidates]
grid_cells = {side}
arm_reach_m = {{low = 0.9, high = 1.0}}

[arm.grasps]
per_object = 40
per_scene = 10
"""
)
PER_SCENE = 8
HERE = ("--workers", "0")  # in the calling process


def submit_arguments(
    out: Path, n: int, *more: str, per_scene: int | str = PER_SCENE, workers: int = 0, config: str = CONFIG
) -> list[str]:
    """The command line of a small run; its configuration is written beside `out`."""
    file = out.parent / f"{out.name}.toml"
    file.write_text(config)
    chosen = ["--candidates-per-scene", str(per_scene), "--workers", str(workers), "--config", str(file)]
    return ["submit", "heuristic", "--n", str(n), "--out", str(out), *chosen, *more]


def make_small_run(out: Path, n: int, *more: str, **choices: Any) -> Path:
    """A finished run of n labels."""
    assert cli.run(submit_arguments(out, n, *more, **choices)) == 0
    return out


def arrays_of(run: Path) -> dict[str, np.ndarray[Any, Any]]:
    """Every array of a sealed run, by name, read by zarr alone."""
    record = store_record(open_storage(run))
    assert record is not None
    group = zarr.open_group(run / record.name, mode="r")
    return {name: np.asarray(array[...]) for name, array in group.arrays()}


def assert_equal_runs(a: Mapping[str, np.ndarray[Any, Any]], b: Mapping[str, np.ndarray[Any, Any]]) -> None:
    """Same names, dtypes, shapes and values, array by array."""
    assert a.keys() == b.keys()
    for name in a:
        assert a[name].dtype == b[name].dtype, name
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


def json_of(capture: pytest.CaptureFixture[str], arguments: list[str]) -> Any:
    """What a reading verb prints with --json."""
    capture.readouterr()
    assert cli.run([*arguments, "--json"]) == 0
    return json.loads(capture.readouterr().out)

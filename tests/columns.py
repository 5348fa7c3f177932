"""Columns of runs, as every reader of them gets them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from datagen.train.reader import Columns, read_shards
from datagen.train.run_parts import JOIN_FIELDS, RunPart, open_parts

CLOUDS = ("points_m", "rgb", "target_mask", "n_points", "target_center_m")
VALUES = ("distance_m", "visibility", "heuristic_score", "base_is_clear", "base_xy_m")
COLUMNS = (*CLOUDS, "sample_id", "label", *VALUES, "camera_height_m", "base_height_m", "arm_reach_m")


def opened(
    place: Path | str, names: Sequence[str] = COLUMNS, allow_incomplete: bool = False
) -> list[RunPart]:
    """The parts of a run with columns."""
    return open_parts([place], list(dict.fromkeys((*names, *JOIN_FIELDS))), allow_incomplete)


def columns_of(place: Path | str, names: Sequence[str] = COLUMNS) -> list[Columns]:
    """Each shard's columns."""
    return list(read_shards(opened(place, names)))

"""Columns of candidates joined with their scenes, one shard at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.schemas.errors import InputError, choices
from datagen.schemas.fields import OUTCOMES, SCHEMAS, Field, Table
from datagen.schemas.run import open_runs
from datagen.schemas.shard_reading import ShardPlace
from datagen.schemas.specification import PLACE_KINDS
from datagen.train.reader import Columns, load_shard, native
from datagen.train.run_parts import JOIN_FIELDS, RunPart, is_sealed_store, open_sealed
from datagen.workers.houses import split_of

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class _Rows:
    """One shard's columns by the names of the table, one row per candidate."""

    part: RunPart
    shard: ShardPlace
    columns: Columns
    scene: npt.NDArray[np.int64]  # row of each candidate's scene

    def stored(self, name: str) -> Array:
        """A stored array; values of a scene are repeated for each of its candidates."""
        values = self.columns[name]
        return values[self.scene] if self.part.arrays[name].dims[0] == "scene" else values

    def one(self, value: Any) -> Array:
        return np.full(len(self.scene), value, None if isinstance(value, float) else object)

    def robot(self) -> Array:
        names = {None if spec.arm is None else spec.arm.robot for spec in self.part.specs}
        return self.one(names.pop() if len(names) == 1 else None)

    def split(self) -> Array:
        houses = self.columns["house_id"]
        return np.array([split_of(str(house)) for house in houses], object)[self.scene]

    def from_target(self, axis: int) -> Array:
        return self.stored("base_xy_m")[:, axis] - self.stored("target_center_m")[:, axis]


# Columns that are not arrays of the store: the arrays that each is made from, and how.
DERIVED: Mapping[str, tuple[tuple[str, ...], Callable[[_Rows], Array]]] = {
    "run": ((), lambda rows: rows.one(rows.part.place)),
    "house": (("house_id",), lambda rows: rows.stored("house_id")),
    "split": (("house_id",), _Rows.split),
    "object": (("object_name",), lambda rows: rows.stored("object_name")[:, 0]),
    "robot": ((), _Rows.robot),
    "base_x_world_m": (("base_xy_m",), lambda rows: rows.stored("base_xy_m")[:, 0]),
    "base_y_world_m": (("base_xy_m",), lambda rows: rows.stored("base_xy_m")[:, 1]),
    "base_yaw_world_rad": (("base_yaw_rad",), lambda rows: rows.stored("base_yaw_rad")),
    "base_x_target_m": (("base_xy_m", "target_center_m"), lambda rows: rows.from_target(0)),
    "base_y_target_m": (("base_xy_m", "target_center_m"), lambda rows: rows.from_target(1)),
    "target_x_world_m": (("target_center_m",), lambda rows: rows.stored("target_center_m")[:, 0]),
    "target_y_world_m": (("target_center_m",), lambda rows: rows.stored("target_center_m")[:, 1]),
    "target_z_world_m": (("target_center_m",), lambda rows: rows.stored("target_center_m")[:, 2]),
    "cost_s": ((), lambda rows: rows.one(rows.shard.wall_s_per_sample)),
    "sample_id": (
        ("sample_id",),
        lambda rows: np.array([row.tobytes().hex() for row in rows.stored("sample_id")]),
    ),
}
# Columns of codes that are given as texts.
MEANINGS: Mapping[str, Sequence[str]] = {"outcome": tuple(OUTCOMES), "place": PLACE_KINDS}
DEFAULT = (
    *("run", "scene_index", "candidate_index", "robot_index", "house", "split", "room_type", "place"),
    "support_type",
    *("object", "robot", "camera_height_m", "base_height_m", "arm_reach_m"),
    *("base_x_world_m", "base_y_world_m", "base_yaw_world_rad", "base_x_target_m", "base_y_target_m"),
    *("target_x_world_m", "target_y_world_m", "target_z_world_m", "distance_m", "mount_distance_m"),
    *("visibility", "heuristic_score", "base_is_clear", "base_clearance_m"),
    *("label", "label_source", "outcome", "trials", "successes", "cost_s"),
)


def valid_columns(fields: Mapping[str, tuple[Table, Field]]) -> list[str]:
    """The columns that a run with these arrays has: derived ones, then its arrays of one value a row."""
    derived = [name for name, (needs, _) in DERIVED.items() if all(need in fields for need in needs)]
    return list(dict.fromkeys([*derived, *(name for name, (_, field) in fields.items() if not field.dims)]))


def needed_arrays(columns: Sequence[str]) -> list[str]:
    """The stored arrays that columns are made from."""
    needed = [n for name in columns for n in (DERIVED[name][0] if name in DERIVED else (name,))]
    return list(dict.fromkeys([*JOIN_FIELDS, *needed]))


def candidate_columns(part: RunPart, shard: ShardPlace, columns: Sequence[str]) -> dict[str, Array]:
    """A shard's columns with one row per candidate; the part must have their `needed_arrays`.

    InputError for a damaged shard.
    """
    stored, bounds = load_shard(shard, {name: part.arrays[name] for name in needed_arrays(columns)})
    rows = _Rows(part, shard, stored, np.repeat(np.arange(len(bounds) - 1), np.diff(bounds)))
    return {
        name: native(DERIVED[name][1](rows) if name in DERIVED else rows.stored(name)) for name in columns
    }


def fields_of(paths: Sequence[str | Path], function: str) -> list[dict[str, tuple[Table, Field]]]:
    """The arrays of each path, by name: their table and description. InputError where there is no run."""
    if not paths:
        raise InputError(function, "paths", "no run is given", "Give the folder of at least one run")
    return [_fields_of(path) for path in paths]


def _fields_of(path: str | Path) -> dict[str, tuple[Table, Field]]:
    if is_sealed_store(path):
        name = open_sealed(path, ("scene_index", "sample_scene_index")).schema
    else:
        name = open_runs(str(path))[0].schema.name
    # Readers compute what stores of older versions lack.
    return {field.name: (table, field) for table, field in SCHEMAS[name].fields}


def refuse_unknown(names: Sequence[str], valid: Sequence[str], place: str) -> None:
    """Raise InputError, with the valid names, for a name that is not one of them."""
    for name in names:
        if name not in valid:
            raise InputError(place, f"columns: {name}", "is not a column of these runs", choices(valid))

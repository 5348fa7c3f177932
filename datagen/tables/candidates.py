"""A pandas table with one row per candidate, joined with its scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas

from datagen.schemas.fields import OUTCOMES, Field, Table
from datagen.schemas.shard_reading import ShardPlace
from datagen.schemas.specification import PLACE_KINDS
from datagen.tables.stored_fields import fields_of, refuse_unknown
from datagen.train.reader import JOIN_FIELDS, Columns, load_shard, native
from datagen.train.run_parts import RunPart, open_parts, refuse_twins
from datagen.workers.houses import split_of

Array = npt.NDArray[Any]


class _Rows:
    """One shard's columns by the names of the table, one row per candidate."""

    def __init__(
        self, part: RunPart, shard: ShardPlace, columns: Columns, scene: npt.NDArray[np.int64]
    ) -> None:
        self._part, self._shard, self._columns, self._scene = part, shard, columns, scene

    def __len__(self) -> int:
        return len(self._scene)

    def stored(self, name: str) -> Array:
        """A stored array; values of a scene are repeated for each of its candidates."""
        values = self._columns[name]
        return values[self._scene] if self._part.arrays[name].dims[0] == "scene" else values

    def one(self, value: Any) -> Array:
        return np.full(len(self), value, None if isinstance(value, float) else object)

    def robot(self) -> Array:
        names = {None if spec.arm is None else spec.arm.robot for spec in self._part.specs}
        return self.one(names.pop() if len(names) == 1 else None)

    def split(self) -> Array:
        houses = self._columns["house_id"]
        return np.array([split_of(str(house)) for house in houses], object)[self._scene]

    def run(self) -> Array:
        return self.one(self._part.place)

    def cost(self) -> Array:
        return self.one(self._shard.wall_s_per_sample)

    def from_target(self, axis: int) -> Array:
        return self.stored("base_xy_m")[:, axis] - self.stored("target_center_m")[:, axis]


# Columns that are not arrays of the store: the arrays that each is made from, and how.
_DERIVED: Mapping[str, tuple[tuple[str, ...], Callable[[_Rows], Array]]] = {
    "run": ((), _Rows.run),
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
    "cost_s": ((), _Rows.cost),
    "sample_id": (
        ("sample_id",),
        lambda rows: np.array([row.tobytes().hex() for row in rows.stored("sample_id")]),
    ),
}
# Columns of codes that are given as texts.
_MEANINGS: Mapping[str, Sequence[str]] = {"outcome": tuple(OUTCOMES), "place": PLACE_KINDS}
_DEFAULT = (
    *("run", "scene_index", "candidate_index", "robot_index", "house", "split", "room_type", "place"),
    "support_type",
    *("object", "robot", "camera_height_m", "base_height_m", "arm_reach_m"),
    *("base_x_world_m", "base_y_world_m", "base_yaw_world_rad", "base_x_target_m", "base_y_target_m"),
    *("target_x_world_m", "target_y_world_m", "target_z_world_m", "distance_m", "mount_distance_m"),
    *("visibility", "heuristic_score", "base_is_clear", "base_clearance_m"),
    *("label", "label_source", "outcome", "trials", "successes", "cost_s"),
)


def candidates(
    *paths: str | Path, columns: Sequence[str] | None = None, allow_incomplete: bool = False
) -> pandas.DataFrame:
    """Return a pandas table with one row per candidate base pose, joined with its scene.

    The base is at `base_x_world_m`, `base_y_world_m` in the frame of the house (z up, floor at 0) with the
    heading `base_yaw_world_rad`, counter-clockwise from x. `base_x_target_m` and
    `base_y_target_m` are along the same axes, from the target's centre. `cost_s` is the wall-clock time
    of the candidate's shard divided by its candidates (unknown for a sealed store without its run).
    `robot` is empty where labels have no particular arm. `split` is the side of the train, val, test
    split that the house belongs to. Texts are categories. Values that a run does not store are missing.

    Args:
        paths: Folders or `s3://` addresses of runs, merged runs or sealed `data.zarr` stores.
        columns: Columns to read: any of the default ones, `sample_id`, and every array of one number or
            text per scene or candidate in docs/reference/data-format.md. Fewer columns are faster.
        allow_incomplete: Read runs that lack a part of their labels, instead of failing.

    Raises:
        InputError: A path is no run, a run is incomplete or damaged, or a column does not exist.

    Examples:
        >>> table = datagen.candidates(run)
        >>> len(table)
        16
        >>> positives = table.groupby("object", observed=True)["label"].mean()
        >>> bool(((positives >= 0) & (positives <= 1)).all())
        True
        >>> datagen.candidates(run, columns=["house", "label"]).columns.tolist()
        ['house', 'label']
    """
    fields = fields_of(paths, "candidates")
    valid = list(dict.fromkeys(name for of_path in fields for name in _valid(of_path)))
    refuse_unknown(columns or (), valid, "candidates")
    names = list(columns) if columns is not None else [name for name in _DEFAULT if name in valid]
    gathered: dict[str, list[Array]] = {name: [] for name in names}
    opened: list[RunPart] = []
    for path, of_path in zip(paths, fields, strict=True):
        there = [name for name in names if name in _valid(of_path)]
        needed = [n for name in there for n in (_DERIVED[name][0] if name in _DERIVED else (name,))]
        parts = open_parts([path], list(dict.fromkeys([*JOIN_FIELDS, *needed])), allow_incomplete)
        opened += parts
        refuse_twins(opened)
        for part in parts:
            for shard in part.shards:
                stored, bounds = load_shard(shard, part.arrays)
                scene = np.repeat(np.arange(len(bounds) - 1), np.diff(bounds))
                rows = _Rows(part, shard, stored, scene)
                for name in names:
                    gathered[name].append(_column(rows, name, there))
    return pandas.DataFrame({name: _joined(name, gathered.pop(name)) for name in names})


def _valid(fields: Mapping[str, tuple[Table, Field]]) -> list[str]:
    derived = [name for name, (needs, _) in _DERIVED.items() if all(need in fields for need in needs)]
    return list(dict.fromkeys([*derived, *(name for name, (_, field) in fields.items() if not field.dims)]))


def _column(rows: _Rows, name: str, there: Sequence[str]) -> Array:
    if name not in there:
        return np.full(len(rows), np.nan)
    return native(_DERIVED[name][1](rows) if name in _DERIVED else rows.stored(name))


def _joined(name: str, parts: Sequence[Array]) -> Any:
    """All shards' values as one column; a shard of a run without it has NaN."""
    values = np.concatenate(parts)
    if name in _MEANINGS:
        codes = np.where(np.isnan(values), -1, values).astype(np.int8)
        return pandas.Categorical.from_codes(codes, categories=list(_MEANINGS[name]))
    return pandas.Categorical(values) if values.dtype.kind == "O" else values

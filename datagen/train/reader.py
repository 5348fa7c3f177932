"""Read columns of runs, one shard at a time, in stored order.

Training reads through `datagen.train.dataset`, which builds batches on the shards that are loaded here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.shard_reading import ShardPlace
from datagen.schemas.stored_arrays import StoredArray
from datagen.train.inputs import I64, Array
from datagen.train.run_parts import JOIN_FIELDS, open_parts

Columns = dict[str, Array]

SCENE_FIELDS = ("points_m", "rgb", "target_mask", "n_points", "target_center_m")
SAMPLE_FIELDS = (
    "sample_id",
    "base_xy_m",
    "camera_height_m",
    "base_height_m",
    "arm_reach_m",
    "distance_m",
    "visibility",
    "heuristic_score",
    "base_is_clear",
    "label",
)


class SampleReader:
    """Shards of one or more runs, merged or not, sealed or not; also of a sealed store without its run.

    `scene_fields` and `sample_fields` choose the columns. Float16 clouds are returned as float32.
    """

    def __init__(
        self,
        paths: Sequence[Path | str],
        scene_fields: Sequence[str] = SCENE_FIELDS,
        sample_fields: Sequence[str] = SAMPLE_FIELDS,
        allow_incomplete: bool = False,
    ) -> None:
        names = list(dict.fromkeys([*scene_fields, *sample_fields, *JOIN_FIELDS]))
        parts = open_parts(paths, names, allow_incomplete)
        arrays = parts[0].arrays
        for dim, names in (("scene", scene_fields), ("sample", sample_fields)):
            for name in names:
                if arrays[name].dims[0] != dim:
                    problem = f"is not a field of {dim}s"
                    raise InputError(parts[0].place, name, problem, "Request it in the other table")
        self._shards = [(shard, part.arrays) for part in parts for shard in part.shards]
        self._fields = {name: arrays[name] for name in (*scene_fields, *sample_fields)}

    def __len__(self) -> int:
        """Samples of all shards."""
        return sum(place.samples for place, _ in self._shards)

    @property
    def n_scenes(self) -> int:
        """Scenes of all shards."""
        return sum(place.scenes for place, _ in self._shards)

    def shards(self) -> Iterator[Columns]:
        """Every shard's columns; `scene_row` has its samples' rows among its scenes."""
        for place, arrays in self._shards:
            columns, bounds = load_shard(place, arrays)
            scene_row = np.repeat(np.arange(len(bounds) - 1), np.diff(bounds))
            yield {"scene_row": scene_row, **{name: native(columns[name]) for name in self._fields}}


def load_shard(place: ShardPlace, arrays: Mapping[str, StoredArray]) -> tuple[Columns, I64]:
    """A shard's columns (with JOIN_FIELDS), and the bounds (scenes + 1,) of each scene's samples."""
    columns = place.read(arrays.values())
    scenes, owners = columns["scene_index"], columns["sample_scene_index"]
    bounds = np.append(np.searchsorted(owners, scenes), len(owners)).astype(np.int64)
    sizes = np.diff(bounds)
    if bounds[0] or (sizes < 0).any() or not np.array_equal(np.repeat(scenes, sizes), owners):
        raise InputError(
            place.url,
            "sample_scene_index",
            "has a sample of a scene outside its shard, or in another order",
            "Repair it with `datagen verify --repair`",
        )
    return columns, bounds


def native(values: Array) -> Array:
    """Values in this machine's byte order, half floats as float32; text as it is."""
    if values.dtype.kind == "O":
        return values
    wide = np.float32 if values.dtype == np.float16 else values.dtype.newbyteorder("=")
    return values.astype(wide, copy=False)

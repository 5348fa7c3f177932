"""Read columns of runs, one shard at a time, in stored order.

Training reads through `datagen.train.dataset`, which builds batches on the shards that are loaded here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.shard_reading import ShardPlace
from datagen.schemas.stored_arrays import StoredArray
from datagen.train.inputs import I64, Array
from datagen.train.run_parts import JOIN_FIELDS, RunPart

Columns = dict[str, Array]


def read_shards(parts: Sequence[RunPart]) -> Iterator[Columns]:
    """Every shard's columns; `scene_row` has its samples' rows among its scenes."""
    for part in parts:
        for place in part.shards:
            columns, bounds = load_shard(place, part.arrays)
            scene_row = np.repeat(np.arange(len(bounds) - 1), np.diff(bounds))
            yield {"scene_row": scene_row, **{name: native(values) for name, values in columns.items()}}


def load_shard(place: ShardPlace, arrays: Mapping[str, StoredArray]) -> tuple[Columns, I64]:
    """A shard's columns (with JOIN_FIELDS), and the bounds (scenes + 1,) of each scene's samples."""
    columns = place.read(arrays.values())
    scenes, owners = (columns[name] for name in JOIN_FIELDS)
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

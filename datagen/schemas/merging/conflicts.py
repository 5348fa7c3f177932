"""Check that runs with the same scenes have equal rows.

Files may differ where rows do not: by the version of the compressor or the size of shards.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.schemas.errors import InputError
from datagen.schemas.fields import RecordSchema, SceneRows
from datagen.schemas.run import Run
from datagen.schemas.shard_reading import read_scenes


def refuse_different_rows(one: Run, shard_one: int, other: Run, shard_other: int) -> None:
    """Raise InputError where two committed shards have different rows for a common scene.

    It names both runs, the shard, and the first differing sample and field. InputError also for a damaged
    object.
    """
    size, size_other = one.layout.scenes_per_shard, other.layout.scenes_per_shard
    first = max(size * shard_one, size_other * shard_other)
    scenes = range(first, min(size * (shard_one + 1), size_other * (shard_other + 1)))
    for ours, theirs in zip(read_scenes(one, scenes), read_scenes(other, scenes), strict=True):
        found = _first_difference(one.schema, ours, theirs)
        if found is None:
            continue
        field, row = found
        sample = bytes(ours.samples["sample_id"][row]).hex()
        raise InputError(
            one.storage.url,
            f"shard {shard_one}",
            f"{other.storage.url} has other rows, first in sample {sample}, in {field}",
            "Run `datagen verify` on both, and merge without the wrong one",
        )


def _first_difference(schema: RecordSchema, ours: SceneRows, theirs: SceneRows) -> tuple[str, int] | None:
    """The first field and sample row that differ in a scene; row 0 where the scene's record differs."""
    for field in schema.scene_fields:
        if not _equal(np.asarray(ours.record[field.name]), np.asarray(theirs.record[field.name])):
            return field.name, 0
    found: list[tuple[int, int, str]] = []
    for position, field in enumerate(schema.sample_fields):
        a, b = ours.samples[field.name], theirs.samples[field.name]
        if not _equal(a, b):
            row = next(k for k in range(len(a)) if not _equal(a[k : k + 1], b[k : k + 1]))
            found.append((row, position, field.name))
    return (min(found)[2], min(found)[0]) if found else None


def _equal(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> bool:
    """Whether two arrays are equal bit for bit."""
    if a.dtype.kind == "O":
        return bool(np.array_equal(a, b))
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()

"""A pandas table with one row per candidate, joined with its scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas

from datagen.tables.candidate_rows import (
    DEFAULT,
    MEANINGS,
    Array,
    candidate_columns,
    fields_of,
    needed_arrays,
    refuse_unknown,
    valid_columns,
)
from datagen.train.run_parts import RunPart, open_parts, refuse_twins


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
    valid = list(dict.fromkeys(name for of_path in fields for name in valid_columns(of_path)))
    refuse_unknown(columns or (), valid, "candidates")
    names = [name for name in dict.fromkeys(DEFAULT if columns is None else columns) if name in valid]
    gathered: dict[str, list[Array]] = {name: [] for name in names}
    opened: list[RunPart] = []
    for path, of_path in zip(paths, fields, strict=True):
        there = [name for name in names if name in valid_columns(of_path)]
        parts = open_parts([path], needed_arrays(there), allow_incomplete)
        opened += parts
        refuse_twins(opened)
        for part in parts:
            for shard in part.shards:
                columns_there = candidate_columns(part, shard, there)
                for name in names:
                    column = columns_there.get(name)
                    gathered[name].append(np.full(shard.samples, np.nan) if column is None else column)
    return pandas.DataFrame({name: _joined(name, gathered.pop(name)) for name in names})


def _joined(name: str, parts: Sequence[Array]) -> Any:
    """All shards' values as one column; a shard of a run without it has NaN."""
    values = np.concatenate(parts)
    if name in MEANINGS:
        codes = np.where(np.isnan(values), -1, values).astype(np.int8)
        return pandas.Categorical.from_codes(codes, dtype=pandas.CategoricalDtype(list(MEANINGS[name])))
    return pandas.Categorical(values) if values.dtype.kind == "O" else values

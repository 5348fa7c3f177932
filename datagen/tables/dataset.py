"""Runs as one xarray Dataset that reads an array when it is used."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray
from xarray.backends import BackendArray
from xarray.core import indexing

from datagen.schemas.fields import Table
from datagen.schemas.shard_files import cf_attributes, described
from datagen.schemas.shard_reading import ShardPlace
from datagen.schemas.stored_arrays import StoredArray
from datagen.tables.candidate_rows import fields_of, refuse_unknown
from datagen.train.run_parts import RunPart, open_parts, refuse_twins

_Shard = tuple[ShardPlace, StoredArray]
# Dimension of the stores -> of the Dataset, where samples are named candidates.
_DIMS = {"scene": "scene", "sample": "candidate"}
_COORDINATES = ("scene_index", "house_id", "candidate_index", "robot_index")


def open_dataset(
    *paths: str | Path, columns: Sequence[str] | None = None, allow_incomplete: bool = False
) -> xarray.Dataset:
    """Open runs as one lazy xarray Dataset: no array is read before it is used.

    Dimensions are `scene` and `candidate`; the coordinate `scene_row` has each candidate's row along
    `scene`, and `run` each scene's path. Every array has `units`, `long_name`, `frame` and its valid
    range as attributes; the Dataset has title, source, licences and history (CF and ACDD).

    Scenes and candidates are two tables. For a data frame call `datagen.candidates`, which joins them:
    `Dataset.to_dataframe` would make a row for every pair of a scene and a candidate.

    Args:
        paths: Folders or `s3://` addresses of runs, merged runs or sealed `data.zarr` stores.
        columns: Arrays to open; if not given, all that every one of these runs stores.
        allow_incomplete: Open runs that lack a part of their labels, instead of failing.

    Raises:
        InputError: A path is no run, a run is incomplete or damaged, or an array does not exist.

    Examples:
        >>> dataset = datagen.open_dataset(run)
        >>> dict(dataset.sizes)["scene"], dict(dataset.sizes)["candidate"]
        (2, 16)
        >>> dataset["base_xy_m"].attrs["units"], dataset["base_xy_m"].attrs["frame"]
        ('m', 'world')
        >>> cloud = dataset["points_m"].isel(scene=dataset["scene_row"][0])  # read here, of one scene
    """
    each = fields_of(paths, "open_dataset")
    shared = {name: field for name, field in each[0].items() if all(name in other for other in each[1:])}
    refuse_unknown(columns or (), list(shared), "open_dataset")
    names = list(dict.fromkeys([*_COORDINATES, *(columns or shared)]))
    parts = open_parts(paths, names, allow_incomplete)
    refuse_twins(parts)
    shards = [(shard, part.arrays) for part in parts for shard in part.shards]
    variables = {
        name: _variable([(shard, arrays[name]) for shard, arrays in shards], *shared[name]) for name in names
    }
    specs, sources = [s for part in parts for s in part.specs], [s for part in parts for s in part.sources]
    attributes = described(specs, sources)
    if len(parts) == 1:  # a sealed store states what its runs' manifests did
        attributes |= {name: parts[0].attributes[name] for name in attributes if name in parts[0].attributes}
    coordinates = {name: variables.pop(name) for name in _COORDINATES} | _rows(parts)
    return xarray.Dataset(variables, coordinates, attributes)


def _variable(shards: Sequence[_Shard], table: Table, field: Any) -> xarray.Variable:
    array = shards[0][1]
    attributes = {**array.attributes, **cf_attributes(field, table)}
    attributes.pop("coordinates", None)  # xarray's own are set
    lazy = indexing.LazilyIndexedArray(_ShardedArray(shards))
    return xarray.Variable((_DIMS[table], *array.dims[1:]), lazy, attributes)


def _rows(parts: Sequence[RunPart]) -> dict[str, xarray.Variable]:
    """The coordinates `scene_row` and `run`, which need no array to be read."""
    rows, runs, first = [np.zeros(0, np.int64)], list[str](), 0
    for part in parts:
        for shard in part.shards:
            rows.append(first + np.arange(shard.samples) // (shard.full_samples // shard.full_scenes))
            first += shard.scenes
            runs += [part.place] * shard.scenes
    attributes = {"long_name": "row of the candidate's scene along the dimension scene", "units": "1"}
    return {
        "scene_row": xarray.Variable("candidate", np.concatenate(rows), attributes),
        "run": xarray.Variable("scene", np.array(runs, object), {"long_name": "run that the scene lies in"}),
    }


class _ShardedArray(BackendArray):
    """An array over all shards; an index reads only the shards that it touches."""

    def __init__(self, shards: Sequence[_Shard]) -> None:
        first = shards[0][1]
        self._shards = shards
        lengths = [s.scenes if a.dims[0] == "scene" else s.samples for s, a in shards]
        self._ends = np.cumsum(lengths)
        self.shape = (int(self._ends[-1]), *first.shape[1:])
        self.dtype = np.dtype(object if first.is_text else first.dtype)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        support = indexing.IndexingSupport.OUTER
        return indexing.explicit_indexing_adapter(key, self.shape, support, self._read)

    def _read(self, key: tuple[Any, ...]) -> Any:
        rows = np.arange(self.shape[0])[key[0]]
        wanted = np.atleast_1d(rows)
        owner = np.searchsorted(self._ends, wanted, side="right")
        out = np.empty((len(wanted), *self.shape[1:]), self.dtype)
        for k in np.unique(owner):
            shard, array = self._shards[k]
            values = shard.read([array])[array.name]
            mine = owner == k
            out[mine] = values[wanted[mine] - (self._ends[k] - len(values))]
        # One axis after the other, the last first: numpy would pair several lists of indices.
        for axis in range(len(key) - 1, 0, -1):
            out = out[(*(slice(None),) * axis, key[axis])]
        return out if np.ndim(rows) else out[0]

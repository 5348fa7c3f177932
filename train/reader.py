"""Samples streamed from runs: whole shards, shuffled through a buffer, the same for one seed.

A batch holds the sample fields, `scene_row` (its samples' rows among the batch's scenes), the
scene fields, and `run_row` (its samples' runs, by their place in the argument). The scene arrays
are those of the whole buffer and are shared by its batches: treat them as read-only.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from schemas.errors import InputError, choices
from schemas.keys import shard_folder
from schemas.merged import open_runs
from schemas.run import Run
from schemas.shard_reading import ShardPlace, StoredArray, committed_place, read_metadata
from schemas.storage import open_storage
from train.sealed import is_sealed_store, open_sealed

Array = npt.NDArray[Any]
Batch = dict[str, Array]

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


@dataclass(frozen=True)
class _Block:
    """Samples with the scenes they point to by `scene_row`."""

    samples: Batch
    scenes: Batch

    def __len__(self) -> int:
        return len(self.samples["scene_row"])

    def batch(self, rows: npt.NDArray[np.intp]) -> Batch:
        return {**{name: a[rows] for name, a in self.samples.items()}, **self.scenes}

    def take(self, rows: npt.NDArray[np.intp]) -> _Block:
        """The given samples with only the scenes that they need."""
        used, scene_row = np.unique(self.samples["scene_row"][rows], return_inverse=True)
        samples = {name: a[rows] for name, a in self.samples.items()}
        samples["scene_row"] = scene_row.astype(np.int64)
        return _Block(samples, {name: a[used] for name, a in self.scenes.items()})


class SampleReader:
    """Samples of one or more runs, merged or not, sealed or not; also of a sealed store that came alone.

    `scene_fields` and `sample_fields` choose what is read (text fields on request). Float16 clouds
    come as float32. InputError names what is missing, foreign or damaged.
    """

    def __init__(
        self,
        places: Sequence[Path | str],
        scene_fields: Sequence[str] = SCENE_FIELDS,
        sample_fields: Sequence[str] = SAMPLE_FIELDS,
    ) -> None:
        if not places:
            raise InputError("training data", "", "no run is named", "Name at least one run's folder")
        self._places = list(places)
        self._shards: list[tuple[int, ShardPlace, Mapping[str, StoredArray]]] = []
        self.fields: dict[str, StoredArray] = {}
        needed = list(dict.fromkeys([*scene_fields, *sample_fields, "scene_index", "sample_scene_index"]))
        for run_row, place in enumerate(places):
            for shards, arrays in _open(place, needed):
                self._refuse_other_fields(str(place), arrays, scene_fields, sample_fields)
                self._shards += [(run_row, shard, arrays) for shard in shards]
        self._scene_fields = tuple(dict.fromkeys(scene_fields))
        self._sample_fields = tuple(dict.fromkeys(sample_fields))

    def __len__(self) -> int:
        """Samples of one epoch."""
        return sum(place.samples for _, place, _ in self._shards)

    @property
    def n_scenes(self) -> int:
        """Scenes of one epoch."""
        return sum(place.scenes for _, place, _ in self._shards)

    def units(self) -> dict[str, str]:
        """Unit of every field of a batch, "" for names."""
        return {name: str(array.attributes.get("units", "")) for name, array in self.fields.items()}

    def dimension(self, name: str) -> str:
        """`scene` or `sample`: the table that holds a field. InputError where no run stores it."""
        return next(iter(_open(self._places[0], [name])))[1][name].dims[0]

    def epoch(
        self,
        batch_size: int,
        rng: np.random.Generator | None = None,
        buffer_shards: int = 8,
        drop_last: bool = False,
    ) -> Iterator[Batch]:
        """All samples once, in batches of `batch_size`; the last may be shorter unless dropped.

        With `rng`, shards are permuted and samples are shuffled within every `buffer_shards`
        shards; without, all come in stored order. Memory: one buffer and what is left of the last.
        """
        if batch_size < 1 or buffer_shards < 1:
            raise InputError("training data", "batch_size, buffer_shards", "below 1", "Ask for 1 or more")
        order = np.arange(len(self._shards)) if rng is None else rng.permutation(len(self._shards))
        rest: _Block | None = None
        for start in range(0, len(order), buffer_shards):
            loaded = [self._load(int(i)) for i in order[start : start + buffer_shards]]
            block = _join([rest, *loaded] if rest is not None else loaded)
            rows = np.arange(len(block)) if rng is None else rng.permutation(len(block))
            full = len(rows) // batch_size * batch_size
            for i in range(0, full, batch_size):
                yield block.batch(rows[i : i + batch_size])
            rest = block.take(rows[full:]) if full < len(rows) else None
        if rest is not None and not drop_last:
            yield rest.batch(np.arange(len(rest)))

    def shards(self) -> Iterator[Batch]:
        """Every shard as one batch, in stored order."""
        for i in range(len(self._shards)):
            block = self._load(i)
            yield block.batch(np.arange(len(block)))

    def _load(self, index: int) -> _Block:
        run_row, place, arrays = self._shards[index]
        read = place.read(arrays.values())
        scene_row = np.searchsorted(read["scene_index"], read["sample_scene_index"])
        bounded = np.minimum(scene_row, len(read["scene_index"]) - 1)
        if not np.array_equal(read["scene_index"][bounded], read["sample_scene_index"]):
            raise InputError(
                f"{place.storage.url}/{place.folder}",
                "sample_scene_index",
                "a sample names a scene that its shard lacks",
                "Mend it with `datagen repair`",
            )
        samples = {name: _native(read[name]) for name in self._sample_fields}
        samples["scene_row"] = bounded.astype(np.int64)
        samples["run_row"] = np.full(len(bounded), run_row, np.int64)
        return _Block(samples, {name: _native(read[name]) for name in self._scene_fields})

    def _refuse_other_fields(
        self,
        place: str,
        arrays: Mapping[str, StoredArray],
        scene_fields: Sequence[str],
        sample_fields: Sequence[str],
    ) -> None:
        for dim, names in (("scene", scene_fields), ("sample", sample_fields)):
            for name in names:
                if arrays[name].dims[0] != dim:
                    raise InputError(place, name, f"not a field of {dim}s", "Ask for it in the other table")
                known = self.fields.setdefault(name, arrays[name])
                ours, theirs = known.shape[1:], arrays[name].shape[1:]
                if (known.dtype, ours) != (arrays[name].dtype, theirs):
                    problem = f"{arrays[name].dtype} {theirs}, and {known.dtype} {ours} in the runs before"
                    raise InputError(place, name, problem, "Read runs of equal parameters together")


_Opened = tuple[list[ShardPlace], dict[str, StoredArray]]


def _open(place: Path | str, names: Sequence[str]) -> list[_Opened]:
    """The shards of the run, of each of the merged ones, or of the sealed store, with their arrays."""
    if is_sealed_store(place):
        return [open_sealed(place, names)]
    storage = open_storage(place, probe=False, create=False)
    opened = [found for run in open_runs(storage) if (found := _open_run(run, names)) is not None]
    if not opened:
        raise InputError(storage.url, "commits", "no shard is committed", "Make some with `datagen resume`")
    return opened


def _open_run(run: Run, names: Sequence[str]) -> _Opened | None:
    n = run.n
    commits = [commit for commit in run.commits() if commit.shard < run.layout.shards_for(n)]
    if not commits:
        return None
    folders = [shard_folder(commit.shard, commit.attempt) for commit in commits]
    digests = [{entry.path: entry.sha256 for entry in commit.files} for commit in commits]
    paths = [f"{name}/zarr.json" for name in names]
    for name, path in zip(names, paths, strict=True):
        if path not in digests[0]:
            stored = [p.removesuffix("/zarr.json") for p in digests[0] if p.endswith("/zarr.json")]
            raise InputError(run.storage.url, name, "the run stores no such field", choices(stored))
    arrays = read_metadata(run.storage, folders[0], names)
    for folder, digest in zip(folders, digests, strict=True):
        # Merged runs may come from programs that word an array's meaning otherwise.
        if any(digest.get(path) != digests[0][path] for path in paths):
            _refuse_other_arrays(run, folder, arrays)
    shards = [
        committed_place(run.storage, folder, commit, *run.layout.rows_wanted(commit.shard, n))
        for folder, commit in zip(folders, commits, strict=True)
    ]
    return shards, arrays


def _refuse_other_arrays(run: Run, folder: str, arrays: Mapping[str, StoredArray]) -> None:
    for name, array in read_metadata(run.storage, folder, arrays).items():
        if replace(array, attributes=arrays[name].attributes) != arrays[name]:
            raise InputError(
                f"{run.storage.url}/{folder}/{name}/zarr.json",
                name,
                "differs from the other shards' metadata",
                "Mend it with `datagen repair`",
            )


def _join(blocks: Sequence[_Block]) -> _Block:
    if len(blocks) == 1:
        return blocks[0]
    samples = {name: np.concatenate([b.samples[name] for b in blocks]) for name in blocks[0].samples}
    counts = [len(next(iter(b.scenes.values()), ())) for b in blocks]
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    samples["scene_row"] = np.concatenate(
        [b.samples["scene_row"] + start for b, start in zip(blocks, starts, strict=True)]
    )
    scenes = {name: np.concatenate([b.scenes[name] for b in blocks]) for name in blocks[0].scenes}
    return _Block(samples, scenes)


def _native(values: Array) -> Array:
    if values.dtype.kind == "O":
        return values
    wide = np.float32 if values.dtype == np.float16 else values.dtype.newbyteorder("=")
    return values.astype(wide, copy=False)

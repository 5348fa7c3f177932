"""The paths of a report: runs in their parts, sealed stores, checkpoints, evaluations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from datagen.released import checkpoint_file
from datagen.schemas.errors import InputError
from datagen.schemas.fields import SCHEMAS, RecordSchema, SceneRows
from datagen.schemas.merged_runs import open_runs
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit
from datagen.schemas.shard_reading import Array, ShardPlace, StoredArray, committed_place
from datagen.schemas.specification import Specification
from datagen.train.run_parts import is_sealed_store, open_sealed

_FIX = "Name runs, checkpoints of `datagen train`, and documents of `datagen evaluate --json`"


@dataclass(frozen=True, eq=False)
class ReportedPart:
    """A run, one of merged runs, or a sealed store without its run (`run` is None).

    `shards` are the committed ones within n, or slices of the sealed store by number.
    """

    address: str
    specs: Sequence[Specification]  # several of a merged store
    names: frozenset[str]  # the stored arrays
    run: Run | None
    shards: Sequence[int]
    labels: int
    slices: Mapping[int, ShardPlace]  # of a sealed store

    @cached_property
    def commits(self) -> dict[int, Commit]:
        """The commits by shard; empty for a sealed store."""
        return {} if self.run is None else {c.shard: c for c in self.run.commits()}

    @property
    def spec(self) -> Specification:
        """The specification; the first of a merged store's."""
        return self.specs[0]

    @cached_property
    def _arrays(self) -> dict[str, StoredArray]:
        return {}

    def read(self, shard: int, names: Sequence[str]) -> dict[str, Array]:
        """Read these arrays of a shard, only the rows within n. InputError for a damaged file."""
        place = self._place(shard, names)
        if missing := [name for name in names if name not in self._arrays]:
            # Shards of a run have arrays of the same form; an array of another form does not decode.
            self._arrays.update(place.metadata(missing))
        return place.read([self._arrays[name] for name in names])

    def scene(self, shard: int, row: int) -> SceneRows:
        """All that is stored of the scene in row `row` of a shard."""
        names = sorted(self.names)
        stored = self.read(shard, names)
        owners, index = stored["sample_scene_index"], stored["scene_index"][row]
        is_scene = {name: self._arrays[name].dims[0] == "scene" for name in names}
        return SceneRows(
            record={name: stored[name][row] for name in names if is_scene[name]},
            samples={name: stored[name][owners == index] for name in names if not is_scene[name]},
        )

    def _place(self, shard: int, names: Sequence[str]) -> ShardPlace:
        if self.run is None:
            return self.slices[shard]
        rows = self.run.layout.rows_wanted(shard, self.run.n)
        return committed_place(self.run.storage, self.run.commit_of(shard), names, *rows)


@dataclass(frozen=True)
class ReportPaths:
    """The paths of a report by kind."""

    runs: tuple[tuple[str, tuple[ReportedPart, ...]], ...]
    checkpoints: tuple[Path, ...]
    evaluations: tuple[Path, ...]


def open_report_paths(paths: Sequence[str]) -> ReportPaths:
    """Open the runs, and separate checkpoints from evaluations. InputError for other paths."""
    runs: list[tuple[str, tuple[ReportedPart, ...]]] = []
    checkpoints: list[Path] = []
    evaluations: list[Path] = []
    for path in dict.fromkeys(paths):
        if "://" in path or Path(path).is_dir():
            runs.append((path, _open_run(path)))
        elif (file := checkpoint_file(path)) is None:
            raise InputError(path, "", "is neither a run's folder nor a file", _FIX)
        elif _is_json(Path(file)):
            evaluations.append(Path(file))
        else:
            checkpoints.append(Path(file))
    return ReportPaths(tuple(runs), tuple(checkpoints), tuple(evaluations))


def _is_json(path: Path) -> bool:
    if path.suffix.lower() == ".json":  # even where it is empty
        return True
    try:
        with open(path, "rb") as file:
            return file.read(64).lstrip()[:1] in (b"{", b"[")
    except OSError as error:
        raise InputError(path, "", f"cannot be read: {error.strerror}", _FIX) from None


def _open_run(path: str) -> tuple[ReportedPart, ...]:
    if is_sealed_store(path):
        sealed = open_sealed(path, ("scene_index", "sample_scene_index"))
        slices = dict(enumerate(sealed.shards))
        labels = sum(place.samples for place in sealed.shards)
        schema = SCHEMAS[sealed.schema].at(sealed.schema_version)
        return (ReportedPart(path, sealed.specs, _names(schema), None, tuple(slices), labels, slices),)
    parts: list[ReportedPart] = []
    for run in open_runs(path):
        n = run.n
        shards = [shard for shard in sorted(run.committed()) if shard < run.layout.shards_for(n)]
        labels = sum(run.layout.rows_wanted(shard, n)[1] for shard in shards)
        address, names = run.storage.url, _names(run.schema)
        parts.append(ReportedPart(address, (run.manifest.spec,), names, run, shards, labels, {}))
    return tuple(parts)


def _names(schema: RecordSchema) -> frozenset[str]:
    return frozenset(field.name for _, field in schema.fields)

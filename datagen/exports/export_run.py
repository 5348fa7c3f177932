"""Export the scenes of a run, step by step: an interrupted export continues with its next step."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from datagen import __version__
from datagen.console.options import AS_FOUND, AssetSources
from datagen.exports import FORMATS
from datagen.exports.export_record import (
    ExportedFile,
    ExportRecord,
    is_intact,
    read_export,
    refuse_other_export,
    run_digest,
)
from datagen.schemas.errors import InputError
from datagen.schemas.fields import SceneRows
from datagen.schemas.run import Rows, Run, label_counts, open_runs
from datagen.schemas.run_records import FileEntry
from datagen.schemas.shard_files import described
from datagen.schemas.shard_reading import ShardPlace, read_scenes
from datagen.schemas.storage import Storage, open_storage
from datagen.train.run_parts import RunPart, open_parts
from datagen.workers import registry

Shard = tuple[RunPart, ShardPlace]
# Scenes in a file of tables or clouds: 64 MiB of clouds of 4096 points.
SCENES_PER_FILE = 1024
# Of one export, so that its record stays small; and how often that is written.
_MOST_STEPS, _RECORD_EVERY_S = 20_000, 10.0
# Axes whose lengths may differ between merged runs.
_UNEVEN = ("object", "point")


@dataclass(frozen=True)
class NewFile:
    """A file that a step has made; `counts` are kept in the record for later steps."""

    path: str
    data: bytes
    counts: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Made:
    """The files of the steps before, in order."""

    storage: Storage
    files: Sequence[ExportedFile]

    def sums(self, *counts: str) -> list[int]:
        return [sum(file.counts.get(name, 0) for file in self.files) for name in counts]


Step = Callable[[Made], Iterable[NewFile]]


@dataclass(frozen=True, eq=False)
class ExportSource:
    """Scenes `first` to `past` (exclusive) of a run, counted over all merged runs."""

    path: str
    runs: Sequence[Run]
    first: int
    past: int
    given: AssetSources = AS_FOUND
    _worlds: dict[str, Any] = field(default_factory=dict)

    @property
    def about(self) -> dict[str, Any]:
        """Title, licences and history, as a sealed store's attributes."""
        manifests = [run.manifest for run in self.runs]
        return described([m.spec for m in manifests], [m.sources for m in manifests])

    def shards(self, names: Sequence[str]) -> list[list[Shard]]:
        """The shards with the named arrays, cut to these scenes, in groups for one file each."""
        fields = {f.name: f for _, f in self.runs[0].schema.fields}
        uneven = [n for n in names if n in fields and set(fields[n].dims) & set(_UNEVEN)]
        groups: list[list[Shard]] = []
        start = scenes = 0
        for part in open_parts([self.path], names, uneven=uneven):
            for place in part.shards:
                low, high = max(self.first - start, 0), min(self.past - start, place.scenes)
                start += place.scenes
                if low < high:
                    if not groups or scenes + high - low > SCENES_PER_FILE:
                        groups, scenes = [*groups, []], 0
                    groups[-1].append((part, _cut(place, low, high)))
                    scenes += high - low
        return groups

    def scenes(self, first: int, past: int) -> Iterator[tuple[Run, SceneRows]]:
        """Each scene's run and rows, in order: its record, and those of its candidates that count."""
        start = 0
        for run in self.runs:
            each, n = run.layout.candidates_per_scene, run.n
            counted = run.counted(n)
            indices = [counted[k] for k in range(max(first - start, 0), min(past - start, len(counted)))]
            start += len(counted)
            for index, rows in zip(indices, read_scenes(run, indices), strict=True):
                samples = {name: values[: n - index * each] for name, values in rows.samples.items()}
                yield run, SceneRows(rows.record, samples)

    def each_scene(self, file: Callable[[Run, SceneRows], Iterable[NewFile]]) -> list[Step]:
        """A step for each scene, which makes files of it."""

        def step(position: int, _: Made) -> Iterable[NewFile]:
            return file(*next(self.scenes(position, position + 1)))

        return [partial(step, position) for position in range(self.first, self.past)]

    def rebuilt(self, run: Run, record: Mapping[str, Any]) -> Any:
        """The geometry of a scene (`ReconstructedScene`). InputError without its houses and objects."""
        # Imported here: tables need none of the libraries of scenes.
        from datagen.replaying import places_of
        from datagen.workers.scenes.reconstruct import reconstruct_scene
        from datagen.workers.world import open_world

        if run.storage.url not in self._worlds:
            self._worlds.clear()  # a world is large
            self._worlds[run.storage.url] = open_world(run.manifest.spec, *places_of(run, self.given))
        return reconstruct_scene(self._worlds[run.storage.url], record)


def _cut(place: ShardPlace, low: int, high: int) -> ShardPlace:
    each, rows = place.full_samples // place.full_scenes, place.rows
    samples = min(high * each, rows.samples) - low * each
    return replace(place, rows=Rows(rows.first + low, high - low, samples))


def scene_key(run_hash: str, scene_index: int) -> str:
    """Name of a scene in every export: 12 digits of its specification's hash, and its index."""
    return f"{run_hash[:12]}-{scene_index:06d}"


def open_source(run: str, scenes: str | None, given: AssetSources) -> ExportSource:
    """The scenes `FIRST:PAST` [all] of a run. InputError where it is incomplete or has no such scenes."""
    runs = open_runs(run)
    counts = label_counts(runs)
    if counts.labels < counts.n:
        problem = f"{counts.n - counts.labels:,} of the {counts.n:,} planned samples are missing"
        lacking = next((each for each in runs if each.quarantined()), runs[0])
        raise InputError(run, "commits", problem, f"Make them: {lacking.command_for_missing}")
    total = sum(len(each.counted(each.n)) for each in runs)
    if scenes is None:
        return ExportSource(run, runs, 0, total, given)
    found = re.fullmatch(r"([0-9]{1,15})(?::([0-9]{1,15}))?", scenes)
    first, past = (int(found[1]), int(found[2] or int(found[1]) + 1)) if found else (0, 0)
    if not first < past <= total:
        fix = f"Give one from 0 to {total - 1}, or FIRST:PAST, as 0:{total}"
        raise InputError("--scenes", scenes[:40], f"is not a range of the run's {total} scenes", fix)
    return ExportSource(run, runs, first, past, given)


def export_run(
    source: ExportSource, to: str, out: str | Path, seen: Callable[[int, int], None] | None = None
) -> tuple[Storage, ExportRecord]:
    """Write the files of an export; those that a former call has written are kept where they are intact.

    `seen` receives the number of steps done, and of all. InputError for an unknown format, for a folder with
    other files or another export, and for scenes that cannot be read.
    """
    steps: Sequence[Step] = registry.entry(FORMATS, to, "--to")(source)
    about, run = source.about, open_storage(source.path, probe=False, create=False)
    storage = open_storage(out, probe=False)
    wanted = ExportRecord(
        format=to,
        version=__version__,
        run=os.path.relpath(run.folder, storage.folder) if run.folder and storage.folder else run.url,
        run_sha256=run_digest(source.runs),
        spec_hashes=tuple(each.manifest.spec_hash for each in source.runs),
        scenes=(source.first, source.past),
        license=about["license"],
        acknowledgement=about["acknowledgement"],
    )
    if (found := read_export(storage)) is not None:
        refuse_other_export(storage, found, wanted)
    elif (file := next(iter(storage.list("")), None)) is not None:
        raise InputError(storage.url, file.key, "is not of an export", "Choose a new --out")
    if len(steps) > _MOST_STEPS:
        fix = f"Export at most {_MOST_STEPS:,} --scenes into one folder"
        raise InputError(source.path, "--scenes", f"is {len(steps):,} files or more", fix)
    by_step: dict[int, list[ExportedFile]] = {}
    for file in found.files if found else ():
        by_step.setdefault(file.step, []).append(file)
    made, written_s = list[ExportedFile](), time.monotonic()

    def record(complete: bool = False) -> ExportRecord:
        files = tuple(file for number in sorted(by_step) for file in by_step[number])
        return wanted.model_copy(update={"files": files, "complete": complete})

    record().write(storage)
    try:
        for number, step in enumerate(steps):
            kept = by_step.get(number, ())
            if not kept or not all(is_intact(storage, file) for file in kept):
                by_step[number] = [_write(storage, number, f) for f in step(Made(storage, made))]
            made += by_step[number]
            if seen is not None:
                seen(number + 1, len(steps))
            if time.monotonic() - written_s > _RECORD_EVERY_S:
                record().write(storage)
                written_s = time.monotonic()
    finally:
        record().write(storage)
    finished = record(complete=True)
    finished.write(storage)
    return storage, finished


def _write(storage: Storage, number: int, file: NewFile) -> ExportedFile:
    storage.put(file.path, file.data)
    entry = FileEntry.of(file.path, file.data)
    return ExportedFile(**entry.model_dump(), step=number, counts=dict(file.counts))

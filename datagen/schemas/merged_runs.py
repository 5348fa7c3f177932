"""Open a run, or merged runs, whose parts are runs themselves."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from datagen.schemas.errors import InputError
from datagen.schemas.keys import MERGED, part_folder
from datagen.schemas.record_files import REPAIR, read_record, refuse_other_format
from datagen.schemas.run import Run
from datagen.schemas.run_records import Merged, other_value
from datagen.schemas.storage import Storage, open_storage


def open_runs(path: Storage | Path | str) -> list[Run]:
    """Return the run at `path`, or the parts of merged runs in the order of their rows in the store.

    InputError where there is no run, or one that is damaged or of another format.
    """
    storage = path if isinstance(path, Storage) else open_storage(path, probe=False, create=False)
    merged = read_record(storage, MERGED, Merged)
    if merged is None:
        return [Run.open(storage)]
    refuse_other_format(f"{storage.url}/{MERGED}", merged.format_version)
    runs = [Run.open(storage.below(part_folder(spec_hash))) for spec_hash in merged.parts]
    for run, spec_hash in zip(runs, merged.parts, strict=True):
        if found := other_value(run.manifest, spec_hash=spec_hash):
            raise InputError(f"{run.storage.url}/manifest.json", *found, REPAIR)
    return runs


@dataclass(frozen=True)
class LabelCounts:
    """Planned and committed labels of runs, and the number of missing shards."""

    n: int
    labels: int
    missing: int


def label_counts(runs: Iterable[Run]) -> LabelCounts:
    """Sums over runs. Shards beyond a run's n do not count, and the last one is cut."""
    n = labels = missing = 0
    for run in runs:
        run_n = run.n
        shards = run.layout.shards_for(run_n)
        done = [shard for shard in run.committed() if shard < shards]
        n += run_n
        labels += sum(run.layout.rows_wanted(shard, run_n)[1] for shard in done)
        missing += shards - len(done)
    return LabelCounts(n, labels, missing)


def find_scene(runs: Sequence[Run], scene: int) -> tuple[Run, int]:
    """Return the run with scene `scene` of consecutive runs, and the scene's index in it.

    InputError where there are fewer scenes.
    """
    left = scene
    for run in runs:
        scenes = -(-run.n // run.layout.candidates_per_scene)
        if 0 <= left < scenes:
            return run, left
        left -= scenes
    last = scene - left - 1
    problem = f"{scene} is not in this run" if len(runs) == 1 else f"{scene} is in none of these runs"
    raise InputError(runs[0].storage.url, "--scene", problem, f"Give one from 0 to {last}")

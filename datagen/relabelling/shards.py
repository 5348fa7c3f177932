"""Relabel one shard; its distances, visibilities and files are kept."""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import sha256
from typing import Any

import numpy as np

from datagen.cluster.attempt import ends_job
from datagen.cluster.attempt_guard import Meter, this_host
from datagen.cluster.task import AttemptResult
from datagen.schemas.cost import StageClock
from datagen.schemas.identity import sample_ids
from datagen.schemas.keys import shard_folder
from datagen.schemas.record_files import utc_now
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit, FileEntry
from datagen.schemas.shard_files import encode_array, group_metadata
from datagen.schemas.shard_reading import read_committed
from datagen.workers.labels import distance_visibility_score as formula

Columns = dict[str, np.ndarray[Any, Any]]

_READ = (
    "distance_m", "mount_distance_m", "arm_reach_m", "visibility", "sample_scene_index", "candidate_index",
    "label", "label_version",
)  # fmt: skip


@dataclass(frozen=True)
class RelabelTask:
    """Relabels one shard in this process."""

    shard: int
    attempt: str
    deadline_s: float
    notes: str = ""


@dataclass
class Flips:
    """Counts of changed labels over shards."""

    to_good: int = 0
    to_bad: int = 0


def relabel_shard(run: Run, source: Run, task: RelabelTask, meter: Meter, flips: Flips) -> AttemptResult:
    """Label a committed shard of `source` by the rule of `run`, and commit it there.

    Labels, scores and ids are written, all other files are linked. Raises InputError for a damaged file,
    JobCannotContinue for a full or read-only disk.
    """
    clock = StageClock()
    with ends_job():
        run.ledger.start(task.attempt, task.shard)
    with clock.stage("draw"):
        before = source.commit_of(task.shard)
        source.check_files(before)
        stored = read_committed(source.storage, before, _READ)
    with clock.stage("visibility"):
        made = _relabelled(run, stored)
        files = _made_files(run, made)
    with ends_job(), clock.stage("write"):
        entries, written_bytes = _write(run, source, before, task.attempt, files)
    cost = meter.cost(clock, written_bytes).model_copy(update={"source_s": before.cost.all_s})
    positives = int(made["label"].sum())
    commit = Commit(
        shard=task.shard,
        attempt=task.attempt,
        spec_hash=run.manifest.spec_hash,
        scenes=before.scenes,
        samples=before.samples,
        positives=positives,
        redraws={},  # nothing was sampled
        files=entries,
        cost=cost,
        host=this_host(),
        created=utc_now(),
    )
    with ends_job():
        won = run.commit(commit)
    flips.to_good += int((made["label"] > stored["label"]).sum())
    flips.to_bad += int((made["label"] < stored["label"]).sum())
    return AttemptResult(won, before.samples, positives, cost)


def _relabelled(run: Run, stored: Columns) -> Columns:
    """The columns that depend on the rule."""
    score, label = formula.heuristic(
        stored["distance_m"],
        stored["mount_distance_m"],
        stored["arm_reach_m"],
        stored["visibility"],
        run.manifest.spec.heuristic,
    )
    scene, candidate = stored["sample_scene_index"], stored["candidate_index"]
    starts = np.flatnonzero(np.diff(scene, prepend=scene[0] - 1))
    ids = [
        sample_ids(run.manifest.spec_hash, int(scene[rows[0]]), candidate[rows])
        for rows in np.split(np.arange(len(scene)), starts[1:])
    ]
    return {
        "sample_id": np.concatenate(ids),
        "heuristic_score": score,
        "label": label,
        "label_version": np.full(len(scene), formula.VERSION, np.int16),
    }


def _made_files(run: Run, made: Columns) -> dict[str, bytes]:
    """Metadata and chunks of the columns, by path within the attempt's folder."""
    schema, layout = run.schema, run.layout
    files = dict(group_metadata(schema, layout, run.manifest.spec_hash))
    for field in schema.sample_fields:
        if field.name in made:
            files |= encode_array(schema, layout, "sample", field, made[field.name])
    return files


def _write(
    run: Run, source: Run, before: Commit, attempt: str, files: dict[str, bytes]
) -> tuple[tuple[FileEntry, ...], int]:
    """Write the new files and link the others; return the commit's entries and the bytes written."""
    old, new = shard_folder(before.shard, before.attempt), shard_folder(before.shard, attempt)
    entries: list[FileEntry] = []
    kept: list[tuple[str, str]] = []
    fresh: dict[str, bytes] = {}
    for entry in before.files:
        data = files.get(entry.path)
        made = entry if data is None else _entry(entry.path, data)
        entries.append(made)
        if data is not None and made != entry:
            fresh[f"{new}/{entry.path}"] = data
        else:
            kept.append((f"{old}/{entry.path}", f"{new}/{entry.path}"))
    largest = max((entry.size for entry in before.files), default=0)
    with run.nothing_left_behind(before.shard, attempt, ours=True):
        run.storage.adopt_many(source.storage, kept, largest)
        run.storage.put_many(fresh)
        run.storage.sync(f"{new}/{entry.path}" for entry in entries)
    return tuple(entries), sum(map(len, fresh.values()))


def _entry(path: str, data: bytes) -> FileEntry:
    return FileEntry(path=path, size=len(data), sha256=sha256(data).hexdigest())

"""Relabel all committed shards of a run into a new run; distances, visibilities and files are kept."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from datagen.cluster.attempt import commit_rows, ends_job
from datagen.cluster.attempt_guard import Meter
from datagen.cluster.driver import drive
from datagen.cluster.in_process_executor import InProcessExecutor
from datagen.cluster.job_monitor import JobProgress
from datagen.cluster.protocol import AttemptOrder, AttemptResult, JobSummary, StopRequest, stop_on_signals
from datagen.cluster.run_recorder import RunRecorder
from datagen.cluster.shard_policy import RetryPolicy
from datagen.configuration.specify import manifest_of
from datagen.configuration.stored_scenes import StoredScenes, specify_again
from datagen.display.progress import Progress
from datagen.jobs.job_report import JobResult
from datagen.schemas.errors import InputError
from datagen.schemas.identity import sample_ids
from datagen.schemas.quarantine import lift_quarantine
from datagen.schemas.run import Run
from datagen.schemas.run_records import StageClock
from datagen.schemas.sealing import seal
from datagen.schemas.shard_files import encode_array, group_metadata, zipped
from datagen.schemas.shard_ranges import ShardRanges
from datagen.schemas.shard_reading import ZipFiles, committed_place
from datagen.schemas.specification import Specification
from datagen.schemas.storage import Storage
from datagen.workers.labels import distance_visibility_score as formula
from datagen.workers.labels import load_label_source

Columns = dict[str, np.ndarray[Any, Any]]
_READ = (
    "distance_m", "mount_distance_m", "arm_reach_m", "visibility", "sample_scene_index", "candidate_index",
)  # fmt: skip


def relabelled_specification(
    source: Run, options: dict[str, Any], config: Path | None = None
) -> Specification:
    """Return the specification of `submit heuristic --scenes-from SOURCE` with other parameters of the rule.

    `options` are dotted names. InputError for another label source, for a configuration that would change
    more than the rule, and for visibilities from another version of the label code.
    """
    before, path = source.manifest.spec, source.storage.url
    if before.label_source != "heuristic":
        problem = f"is {before.label_source}: such labels cannot be computed from distance and visibility"
        fix = f"Relabel a heuristic run of these scenes: datagen submit heuristic --scenes-from {path}"
        raise InputError(path, "label_source", problem, fix)
    sources = source.manifest.sources
    stored = StoredScenes(source, sources.get("houses", "builtin"), sources.get("objects", "builtin"))
    spec = specify_again("heuristic", stored, config, options=options)
    if spec.visibility != before.visibility:
        problem = "would change visibilities, which are stored"
        fix = "Remove it, or cast rays again: datagen submit heuristic --scenes-from RUN"
        raise InputError(str(config), "visibility", problem, fix)
    version = str(load_label_source("heuristic").version)
    if (made := before.engines.get("labels")) != version:
        problem = f"visibilities are of version {made} of the label code, not {version}"
        fix = "Cast rays again: datagen submit heuristic --scenes-from RUN"
        raise InputError(path, "engines.labels", problem, fix)
    # rho and distance were computed with the source's versions, whatever is installed here.
    return spec.model_copy(update={"engines": dict(before.engines)})


def relabel_run(storage: Storage, source: Run, spec: Specification, json: bool = False) -> JobResult:
    """Relabel every committed shard of the run that is missing in `storage`, and seal.

    Shards that the source lacks remain. InputError when `storage` holds something else, or is full.
    """
    if not source.committed():
        raise InputError(source.storage.url, "commits", "no shard is committed", "Resume the run first")
    run, stop = _open_target(storage, source, spec), StopRequest()
    lift_quarantine(run)  # a job may have tried shards that the source lacked then
    planned = run.missing()
    missing = planned.within(ShardRanges.of(source.committed()))
    with stop_on_signals(stop, interrupt=True), Progress(json) as shown:
        summary = _relabel_shards(run, source, missing, stop, shown)
    if summary.end == "aborted":
        raise InputError(storage.url, "", f"cannot continue: {summary.cause}", "Then run the command again")
    return JobResult(
        path=storage.url,
        end=summary.end,
        n=run.n,
        made_from=f"{source.storage.url}, {source.manifest.made_from}",
        labels=summary.totals.labels,
        positives=summary.totals.positives,
        shards=len(planned),
        remaining=summary.remaining + len(planned) - len(missing),
        quarantined=tuple(record.shard for record in run.quarantine_records()),
        elapsed_s=summary.elapsed_s,
        store="" if summary.end == "interrupted" or not run.committed() else seal(storage),
        cause=summary.cause,
    )


def _open_target(storage: Storage, source: Run, spec: Specification) -> Run:
    known = source.manifest.sources
    manifest = manifest_of(spec, source.layout, {**known, "scenes_from": source.storage.url})
    # Its other arrays are copied as they are.
    manifest = manifest.model_copy(update={"schema_version": source.manifest.schema_version})
    run = Run.create_or_open(storage, manifest, source.n)
    if run.layout != source.layout:
        problem = f"is {run.layout.scenes_per_shard}, unlike in the source"
        fix = "Choose another --out: arrays are copied shard by shard"
        raise InputError(f"{storage.url}/manifest.json", "layout.scenes_per_shard", problem, fix)
    return run


def _relabel_shards(
    run: Run, source: Run, missing: Sequence[int], stop: StopRequest, shown: Progress
) -> JobSummary:

    def work(task: AttemptOrder, meter: Meter) -> AttemptResult:
        return relabel_shard(run, source, task, meter)

    done, per_shard = len(run.planned()) - len(run.missing()), run.layout.samples_per_shard
    shown.phase("relabelling")
    recorder, executor, events = (
        RunRecorder(run),
        InProcessExecutor(work),
        JobProgress(shown, per_shard, done),
    )
    summary = drive(missing, lambda order: order, executor, recorder, RetryPolicy(), events, stop)
    run.close_lost_attempts()
    return summary


def relabel_shard(run: Run, source: Run, task: AttemptOrder, meter: Meter) -> AttemptResult:
    """Label a committed shard of `source` by the rule of `run`, and commit it there.

    Labels, scores and ids are new, all other arrays are the source's. Raises InputError for a damaged file,
    JobCannotContinue for a full or read-only disk.
    """
    clock = StageClock()
    with ends_job():
        run.ledger.start(task.attempt, task.shard)
    with clock.stage("draw"):
        before = source.commit_of(task.shard)
        place = committed_place(source, before)
        stored = place.read(place.source.metadata(_READ).values())
        kept = ZipFiles(place.url, source.read_object(before))
    with clock.stage("visibility"):
        made = _relabelled(run, stored)
        files = {path: kept.get(path) for path in kept.paths} | _made_files(run, made)
    # Nothing was sampled, so that there are no redraws.
    return commit_rows(run, task, zipped(files), made["label"], clock, meter, {}, before.cost.all_s)


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
    for column in schema.sample_fields:
        if column.name in made:
            files |= encode_array(schema, layout, "sample", column, made[column.name])
    return files

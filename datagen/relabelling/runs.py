"""Relabel all committed shards of runs into a new run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from datagen.cluster.attempt_guard import Meter
from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.in_process_executor import InProcessExecutor
from datagen.cluster.job_progress import JobProgress
from datagen.cluster.job_totals import JobSummary, empty_summary
from datagen.cluster.retry_policy import RetryPolicy
from datagen.cluster.run_recorder import RunRecorder, close_lost_attempts
from datagen.cluster.stop_request import StopRequest, stop_on_signals
from datagen.cluster.task import AttemptResult
from datagen.configuration.manifest import manifest_of
from datagen.configuration.stored_scenes import StoredScenes, specify_again
from datagen.relabelling.shards import Flips, RelabelTask, relabel_shard
from datagen.schemas.errors import InputError
from datagen.schemas.keys import MERGED, part_folder
from datagen.schemas.progress import Progress
from datagen.schemas.record_files import MAX_RECORD_BYTES, encode_record, publish, refuse_foreign
from datagen.schemas.run import Run
from datagen.schemas.run_records import Merged
from datagen.schemas.sealing import seal
from datagen.schemas.shard_ranges import ShardRanges
from datagen.schemas.specification import Specification
from datagen.schemas.storage import Storage
from datagen.workers.labels import load_label_source


@dataclass
class Relabelled:
    """The result of a call, over all runs."""

    runs: list[Run] = field(default_factory=list)
    summary: JobSummary = field(default_factory=empty_summary)
    flips: Flips = field(default_factory=Flips)
    absent: int = 0  # planned shards that the source lacks


def relabelled_specification(
    source: Run, options: dict[str, Any], config: Path | None = None
) -> Specification:
    """Return the specification of `submit heuristic --scenes-from SOURCE` with other parameters of the rule.

    `options` are dotted names. InputError for another label source, for a configuration that would change
    more than the rule, and for visibilities from another version of the label code.
    """
    before, place = source.manifest.spec, source.storage.url
    if before.label_source != "heuristic":
        problem = f"is {before.label_source}: such labels cannot be computed from distance and visibility"
        fix = f"Relabel a heuristic run of these scenes: datagen submit heuristic --scenes-from {place}"
        raise InputError(place, "label_source", problem, fix)
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
        raise InputError(place, "engines.labels", problem, fix)
    # rho and distance were computed with the source's versions, whatever is installed here.
    return spec.model_copy(update={"engines": dict(before.engines)})


def relabel_all(
    place: Storage, sources: Sequence[Run], specs: Sequence[Specification], json: bool = False
) -> Relabelled:
    """Relabel every committed shard of the runs that is missing at `place`, and seal.

    One specification gives a run, several give merged runs. InputError when something else is at `place`.
    """
    for source in sources:
        if not source.committed():
            raise InputError(source.storage.url, "commits", "no shard is committed", "Resume the run first")
    # Runs of the same scenes by different rules become one run: the longest represents them.
    longest: dict[str, tuple[Run, Specification]] = {}
    for source, spec in zip(sources, specs, strict=True):
        found = longest.get(spec.hash())
        if found is None or len(found[0].committed()) < len(source.committed()):
            longest[spec.hash()] = (source, spec)
    pairs = [longest[spec_hash] for spec_hash in sorted(longest)]
    done = Relabelled()
    if len(pairs) > 1:
        _refuse_other_place(place, sorted(longest))
    for source, spec in pairs:
        below = place if len(pairs) == 1 else place.below(part_folder(spec.hash()))
        done.runs.append(_open_target(below, source, spec))
    if len(pairs) > 1:
        _write_merged(place, sorted(longest))
    stop = StopRequest()
    with stop_on_signals(stop, interrupt=True), Progress(json) as shown:
        for run, (source, _) in zip(done.runs, pairs, strict=True):
            planned = run.missing()
            missing = planned.within(ShardRanges.of(source.committed()))
            done.absent += len(planned) - len(missing)
            done.summary = done.summary.plus(_relabel_run(run, source, missing, stop, done.flips, shown))
    if done.summary.end in ("complete", "failed") and any(run.committed() for run in done.runs):
        seal(place)
    return done


def _open_target(place: Storage, source: Run, spec: Specification) -> Run:
    known = source.manifest.sources
    manifest = manifest_of(
        spec, source.layout, {**known, "scenes_from": source.storage.url}, source.manifest.schema_version
    )
    run = Run.create_or_open(place, manifest, source.n)
    if run.layout != source.layout:
        problem = f"is {run.layout.scenes_per_shard}, unlike in the source"
        fix = "Choose another --out: files can be shared only shard by shard"
        raise InputError(f"{place.url}/manifest.json", "layout.scenes_per_shard", problem, fix)
    return run


def _refuse_other_place(place: Storage, hashes: Sequence[str]) -> None:
    """Raise InputError where a place holds anything but these runs, before a part is started."""
    if place.exists("manifest.json"):
        problem = f"holds one run, but {len(hashes)} would be written"
        raise InputError(place.url, "manifest.json", problem, "Choose another --out")
    stored = place.get(MERGED, MAX_RECORD_BYTES)
    if stored is None:
        # An interrupted call may have left parts, and a draft of the record.
        refuse_foreign(place, "parts/", MERGED)
    elif stored != _merged_record(hashes):
        raise _other_runs(place)


def _merged_record(hashes: Sequence[str]) -> bytes:
    return encode_record(Merged(parts=tuple(hashes)))


def _other_runs(place: Storage) -> InputError:
    return InputError(f"{place.url}/{MERGED}", "parts", "has other merged runs", "Choose another --out")


def _write_merged(place: Storage, hashes: Sequence[str]) -> None:
    record = _merged_record(hashes)
    if place.get(MERGED, MAX_RECORD_BYTES) in (None, record):
        publish(place, MERGED, record)
    if place.get(MERGED, MAX_RECORD_BYTES) != record:  # also where another process was faster
        raise _other_runs(place)


def _relabel_run(
    run: Run, source: Run, missing: Sequence[int], stop: StopRequest, flips: Flips, shown: Progress
) -> JobSummary:
    """Relabel the shards of one run in this process; files are linked, not computed."""

    def work(task: RelabelTask, meter: Meter) -> AttemptResult:
        return relabel_shard(run, source, task, meter, flips)

    def make_task(order: AttemptOrder) -> RelabelTask:
        return RelabelTask(order.shard, order.attempt, order.deadline_s)

    done, per_shard = len(run.planned()) - len(run.missing()), run.layout.samples_per_shard
    shown.phase("relabelling")
    recorder, executor, events = (
        RunRecorder(run),
        InProcessExecutor(work),
        JobProgress(shown, per_shard, done),
    )
    summary = drive(missing, make_task, executor, recorder, RetryPolicy(), events, stop)
    close_lost_attempts(run)
    return summary

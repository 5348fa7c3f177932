"""`datagen relabel`: the labels of a run by another rule, from stored distances and visibilities."""

from __future__ import annotations

import shlex
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from cluster.books import RunBooks, close_lost_attempts
from cluster.driver import Order, drive
from cluster.guard import Meter
from cluster.inprocess import InProcessExecutor
from cluster.policy import Policy
from cluster.progress import progress
from cluster.stop import StopRequest, stop_on_signals
from cluster.tally import JobSummary
from cluster.task import Product
from datagen.console.printing import print_json, print_rows, seconds
from datagen.relabelling.shards import Flips, RelabelTask, relabel_shard
from datagen.specifying.stored_scenes import StoredScenes, specify_again
from datagen.submit import manifest_of
from schemas.errors import InputError
from schemas.merged import MERGED, open_runs, part_folder
from schemas.record_files import encode_record
from schemas.run import Run
from schemas.run_records import Merged
from schemas.sealing import seal
from schemas.specification import Specification
from schemas.storage import Storage, open_storage
from workers.labels import load_label_source

Metres = Annotated[float | None, Parameter(help="Metres, or shares of the reach where --distance says so.")]


def relabel(
    run: Annotated[str, Parameter(help="The run's folder or address, also of merged runs.")],
    *,
    out: Annotated[str, Parameter(help="The new run.")],
    mu: Metres = None,
    sigma_l: Metres = None,
    sigma_r: Metres = None,
    d_min: Metres = None,
    d_max: Metres = None,
    a: Annotated[float | None, Parameter(help="Peak of the distance score.")] = None,
    alpha: Annotated[float | None, Parameter(help="Weight of the visibility score.")] = None,
    tau: Annotated[float | None, Parameter(help="Threshold of H.")] = None,
    distance: Annotated[
        Literal["planar", "planar-over-reach", "mount-over-reach"] | None,
        Parameter(help="The distance that the score is a function of."),
    ] = None,
    config: Annotated[Path | None, Parameter(help="TOML file with the section [heuristic].")] = None,
    json: Annotated[bool, Parameter(negative=(), help="Print one JSON document.")] = False,
) -> int:
    """Label a heuristic run by another rule, without rendering.

    What is not given is as in the run; an option wins over the file. The new run is that of `datagen submit
    heuristic --scenes-from RUN`, and shares all files but those of labels, scores and ids. The same command
    again resumes it, and extends it where the run has grown.
    """
    given = {
        "a": a, "mu": mu, "sigma_l": sigma_l, "sigma_r": sigma_r, "d_min": d_min, "d_max": d_max,
        "alpha": alpha, "tau": tau, "distance": distance,
    }  # fmt: skip
    options = {f"heuristic.{name}": value for name, value in given.items() if value is not None}
    sources = open_runs(run)
    specs = [relabelled_specification(source, options, config) for source in sources]
    if all(spec.heuristic == s.manifest.spec.heuristic for spec, s in zip(specs, sources, strict=True)):
        problem = "nothing would change: its labels are by these very parameters"
        raise InputError(run, "heuristic", problem, "Give --mu or another of its parameters, or --config")
    place = open_storage(out)
    started_s = time.monotonic()
    done = relabel_all(place, sources, specs, json)
    return _report(run, out, place, done, time.monotonic() - started_s, json)


@dataclass
class Relabelled:
    """What a call did, over all runs of the place."""

    runs: list[Run] = field(default_factory=list)
    summaries: list[JobSummary] = field(default_factory=list)
    flips: Flips = field(default_factory=Flips)
    absent: int = 0  # planned shards that the source has not

    @property
    def end(self) -> str:
        """How it ended: as the worst of its runs."""
        order = ("complete", "failed", "interrupted", "aborted")
        return max((s.end for s in self.summaries), key=order.index)


def relabelled_specification(
    source: Run, options: dict[str, Any], config: Path | None = None
) -> Specification:
    """The specification of `submit heuristic --scenes-from SOURCE` with other parameters of the rule.

    `options` are dotted names. InputError for another label source, for a configuration that would change
    more than the rule, and for visibilities that another version of the label code counted.
    """
    before, place = source.manifest.spec, source.storage.url
    if before.label_source != "heuristic":
        problem = f"{before.label_source} labels do not follow from distance and visibility"
        mend = f"Relabel a heuristic run of these scenes: datagen submit heuristic --scenes-from {place}"
        raise InputError(place, "label_source", problem, mend)
    sources = source.manifest.sources
    stored = StoredScenes(source, sources.get("houses", "builtin"), sources.get("objects", "builtin"))
    spec = specify_again("heuristic", stored, config, options=options)
    if spec.visibility != before.visibility:
        problem = "decides visibilities, which are those that the run stores"
        mend = "Take it out, or cast rays again: datagen submit heuristic --scenes-from"
        raise InputError(str(config), "visibility", problem, mend)
    version = str(load_label_source("heuristic").version)
    if (made := before.engines.get("labels")) != version:
        problem = f"its visibilities are of version {made} of the label code, and this is {version}"
        mend = "Cast rays again: datagen submit heuristic --scenes-from"
        raise InputError(place, "engines.labels", problem, mend)
    # What moved the bits of rho and distance is what moved them then, whatever is installed here.
    return spec.model_copy(update={"engines": dict(before.engines)})


def relabel_all(
    place: Storage, sources: Sequence[Run], specs: Sequence[Specification], json: bool = False
) -> Relabelled:
    """Relabel every committed shard of the runs that is not there yet, and seal.

    One specification gives a run at `place`, several give merged runs. InputError when something else
    is at `place`.
    """
    for source in sources:
        if not source.committed():
            raise InputError(source.storage.url, "commits", "no shard is committed", "Resume the run first")
    # Runs of the same scenes by different rules become one by one rule: the longest stands for them.
    longest: dict[str, tuple[Run, Specification]] = {}
    for source, spec in zip(sources, specs, strict=True):
        found = longest.get(spec.hash())
        if found is None or len(found[0].committed()) < len(source.committed()):
            longest[spec.hash()] = (source, spec)
    pairs = [longest[spec_hash] for spec_hash in sorted(longest)]
    done = Relabelled()
    for source, spec in pairs:
        below = place if len(pairs) == 1 else place.below(part_folder(spec.hash()))
        done.runs.append(_open_target(below, source, spec))
    if len(pairs) > 1:
        _write_merged(place, sorted(longest))
    stop = StopRequest()
    with stop_on_signals(stop, interrupt=True):
        for run, (source, _) in zip(done.runs, pairs, strict=True):
            missing = sorted(set(run.missing()) & set(source.committed()))
            done.absent += len(set(run.missing()) - set(source.committed()))
            done.summaries.append(_relabel_run(run, source, missing, stop, done.flips, json))
    if done.end in ("complete", "failed") and any(run.committed() for run in done.runs):
        seal(place)
    return done


def _open_target(place: Storage, source: Run, spec: Specification) -> Run:
    known = source.manifest.sources
    manifest = manifest_of(
        spec,
        source.layout,
        {**known, "scenes_from": source.storage.url},
        source.manifest.schema_version,
    )
    run = Run.create_or_open(place, manifest, source.n)
    if run.layout != source.layout:
        problem = f"{run.layout.scenes_per_shard} scenes a shard, where the source has others"
        mend = "Choose another --out: files can be shared only shard by shard"
        raise InputError(f"{place.url}/manifest.json", "layout.scenes_per_shard", problem, mend)
    return run


def _write_merged(place: Storage, hashes: Sequence[str]) -> None:
    if not place.put_new(MERGED, encode_record(Merged(parts=tuple(hashes)))):
        problem = "other runs were merged here"
        raise InputError(f"{place.url}/{MERGED}", "parts", problem, "Choose another --out")


def _relabel_run(
    run: Run, source: Run, missing: Sequence[int], stop: StopRequest, flips: Flips, json: bool
) -> JobSummary:
    """The shards of one run, one after the other in this process: files are linked, not computed."""

    def work(task: RelabelTask, meter: Meter) -> Product:
        return relabel_shard(run, source, task, meter, flips)

    def make_task(order: Order) -> RelabelTask:
        return RelabelTask(order.shard, order.attempt, order.deadline_s, order.memory_factor, notes)

    done, per_shard = len(run.planned()) - len(run.missing()), run.layout.samples_per_shard
    with ExitStack() as stack:
        notes = stack.enter_context(tempfile.TemporaryDirectory(prefix="datagen-notes-"))
        display = stack.enter_context(progress(per_shard, len(missing), done, True if json else None))
        books, executor = RunBooks(run), InProcessExecutor(work)
        summary = drive(missing, make_task, executor, books, Policy(), display, stop)
    close_lost_attempts(run)
    return summary


def _report(run: str, out: str, place: Storage, done: Relabelled, elapsed_s: float, json: bool) -> int:
    labels = sum(summary.tally.labels for summary in done.summaries)
    positives = sum(summary.tally.positives for summary in done.summaries)
    remaining = sum(summary.remaining for summary in done.summaries)
    report = {
        "run": place.url,
        "source": run,
        "end": done.end,
        "spec_hashes": [r.manifest.spec_hash for r in done.runs],
        "labels": labels,
        "wanted": sum(r.n for r in done.runs),
        "positives": positives,
        "now_good": done.flips.to_good,
        "now_bad": done.flips.to_bad,
        "shards_to_come": done.absent,
        "seconds": round(elapsed_s, 3),
    }
    again = f"datagen {shlex.join(sys.argv[1:])}"
    if json:
        print_json(report)
    else:
        rows = [
            ("labels", f"{labels:,} new, {report['wanted']:,} wanted" if labels else "nothing to do"),
            ("positive", f"{100 * positives / labels:.1f}%" if labels else "-"),
            ("changed", f"{done.flips.to_good:,} labels became good, {done.flips.to_bad:,} bad"),
            ("time", seconds(elapsed_s)),
        ]
        if done.absent:
            rows.append(("to come", f"{done.absent} shards that {run} has not: then relabel again"))
        print_rows(f"{done.end}: {out}", rows)
    causes = [s.cause for s in done.summaries if s.end == "aborted"]
    if causes:
        raise InputError(out, "", f"cannot go on: {causes[0]}", f"Then again: {again}")
    if done.end == "failed":
        sys.stderr.write(f"error: {out}: too many shards failed. See: datagen status {shlex.quote(out)}\n")
    if done.end == "interrupted":
        sys.stderr.write(f"interrupted with {remaining} shards to go. Go on with:\n  {again}\n")
    return max(summary.exit_code for summary in done.summaries)

"""The result of a job, and the jobs of a run, as plain values and as lines of text."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, Literal

from datagen.cluster.protocol import EXIT_CODES
from datagen.console.command_lines import command_line, print_interrupted
from datagen.console.printing import (
    counted,
    listed,
    new_labels,
    print_json,
    print_lines,
    print_rows,
    seconds,
    summary_of_stored,
)
from datagen.schemas.errors import one_line
from datagen.schemas.jobs import StoredJob


@dataclass(frozen=True, eq=False)
class JobResult:
    """The result of a job, and the state of its run. Quarantined shards are those that failed repeatedly."""

    path: str  # the run, as the user wrote it
    # detached: another process goes on. failed: too many shards are quarantined. dry-run: nothing was made.
    end: Literal["complete", "failed", "interrupted", "detached", "dry-run"]
    n: int = 0  # labels wanted
    made_from: str = ""  # houses, objects, robot and places
    labels: int = 0  # made by this job
    positives: int = 0  # among them
    shards: int = 0  # that were missing when the job began
    remaining: int = 0  # still missing
    quarantined: tuple[int, ...] = ()
    retries: int = 0
    start_s: float = 0.0  # until the first shard began
    elapsed_s: float = 0.0  # from then on
    store: str = ""  # the sealed store, which zarr and xarray open
    scenes: int = 0  # that a dry run would make
    doubt: str = ""  # asks about the robot where no label of the run is positive
    cause: str = ""  # the most frequent one of a failed job
    resume: tuple[str, ...] = ()  # words of the command that continues, was detached, or a dry run would run
    follow: tuple[tuple[str, str], ...] = ()  # of a detached job: its process, and how to follow and stop it

    @property
    def complete(self) -> bool:
        """Whether the run has all labels that were wanted, but for the allowed share in quarantine."""
        return self.end == "complete"

    @property
    def exit_code(self) -> int:
        """The command line's exit status: 0 good, 1 too many failures, 130 stopped."""
        return EXIT_CODES.get(self.end, 0)


def job_report(job: StoredJob) -> dict[str, Any]:
    """One job: its record, its last state, and its health."""
    record, state = job.record, job.state
    fields = state.model_dump(mode="json", exclude={"format_version", "id"}) if state else {}
    return {
        **record.model_dump(mode="json", exclude={"format_version"}),
        "health": job.health(),
        "heard_s": round(job.silence().total_seconds(), 1),
        "asked_to_stop": job.stop,
        "state": fields,
    }


def readable_by(store: str) -> str:
    """A sealed store and what reads it; other libraries need their own clients and keys for S3."""
    readers = "datagen.open_dataset" if "://" in store else "zarr.open or xarray.open_zarr"
    return f"{store}: {readers} reads it"


def health_line(job: StoredJob) -> str:
    """One line on a job: state, progress, host and process."""
    record, state, health = job.record, job.state, job.health()
    where = f"{record.host}, process {record.pid}"
    if health == "ended" and state is not None:
        return f"ended {state.end}, exit code {state.exit_code} ({where})"
    heard = f"last sign {seconds(job.silence().total_seconds())} ago"
    if health == "dead":
        return f"dead: its process has ended, {heard} ({where})"
    if state is None or state.phase == "starting":
        return f"{'silent' if health == 'silent' else 'starting'}, {heard} ({where})"
    left = "?" if state.left_s is None else seconds(state.left_s)
    doing = "sealing" if state.phase == "sealing" else f"{state.labels_per_s:,.1f} labels/s, {left} left"
    if state.stopping:
        doing = f"stopping, {state.in_flight} running"
    elif job.stop is not None:
        doing += ", asked to stop"
    silent = "silent, " if health == "silent" else ""
    return f"{silent}{state.done} of {counted(state.shards, 'shard')}, {doing}, {heard} ({where})"


def print_job(result: JobResult, *, json: bool = False, **_: Any) -> int:
    """Print the summary of a job and return the exit code."""
    with nullcontext() if result.end == "dry-run" else summary_of_stored():
        if json:
            print_json(_document(result))
        elif result.end == "dry-run":
            _print_dry_run(result)
        elif result.end == "detached":
            print_rows(f"detached: {command_line(result.resume)}", result.follow)
        else:
            _print(result)
    if result.end == "failed":
        most = f", most often by: {result.cause}" if result.cause else ""
        see = command_line(["status", result.path])
        sys.stderr.write(
            one_line(f"error: {result.path}: too many shards are quarantined{most}. See: {see}") + "\n"
        )
    if result.end == "interrupted":
        print_interrupted(f"; {counted(result.remaining, 'shard')} left", result.resume)
    return result.exit_code


def _document(result: JobResult) -> dict[str, Any]:
    values = {"run": result.path, **vars(result), "command": command_line(result.resume)}
    del values["path"], values["resume"]
    return values | {"follow": dict(result.follow), "quarantined": list(result.quarantined)}


def _print_dry_run(result: JobResult) -> None:
    command = command_line(result.resume)
    rows = [
        ("labels", f"{result.n:,}"),
        ("made from", result.made_from),
        ("missing", f"{counted(result.shards, 'shard')} of {counted(result.scenes, 'scene')}"),
    ]
    print_rows(f"dry run: {result.path}", rows)
    print_lines(f"Make them with:\n  {command}")


def _print(result: JobResult) -> None:
    n, path = result.n, result.path
    if result.shards:
        labels = new_labels(result.labels, n)
    elif result.quarantined:
        labels = f"nothing to do: the shards of {n:,} labels are committed or quarantined"
    else:
        labels = f"nothing to do: all {n:,} labels are committed"
    rows = [
        ("labels", labels),
        ("made from", result.made_from),
        ("positive", f"{100 * result.positives / result.labels:.1f}%" if result.labels else "-"),
        ("time", _time(result)),
        ("retries", str(result.retries)),
    ]
    if result.quarantined:
        again = command_line(["resume", path, "--quarantined"])
        those = f"{counted(len(result.quarantined), 'shard')} ({listed(result.quarantined)})"
        rows.append(("quarantined", f"{those}; try again: {again}"))
    if result.store:
        rows.append(("store", readable_by(result.store)))
    print_rows(f"{result.end}: {path}", rows)
    print_lines(result.doubt)


def _time(result: JobResult) -> str:
    if not result.labels:
        return seconds(result.start_s + result.elapsed_s)
    rate = result.labels / max(result.elapsed_s, 1e-6)
    parts = f"start {seconds(result.start_s)}, labels {seconds(result.elapsed_s)}"
    return f"{seconds(result.start_s + result.elapsed_s)}: {parts} at {rate:,.0f}/s"

"""The result of a job, and the jobs of a run, as plain values and as lines of text."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from datagen.cluster.run_forecast import shown_range
from datagen.cluster.shard_costs import Interval
from datagen.console.command_lines import command_line, print_interrupted, resume_with
from datagen.console.printing import counted, listed, print_json, print_rows, seconds
from datagen.jobs.forecast import Forecast, print_forecast
from datagen.schemas.errors import one_line
from datagen.schemas.jobs import StoredJob

_EXIT_CODES = {
    **{"complete": 0, "detached": 0, "dry-run": 0},
    **{"failed": 1, "aborted": 2, "budget": 3, "interrupted": 130},
}


@dataclass(frozen=True, eq=False)
class JobResult:
    """The result of a job, and the state of its run. Quarantined shards are those that failed repeatedly."""

    path: str  # the run, as the user wrote it
    # detached: Ray makes the labels. failed: more shards are quarantined than allowed. budget: it allows no
    # further shard. dry-run: nothing was made.
    end: Literal["complete", "budget", "failed", "interrupted", "aborted", "detached", "dry-run"]
    n: int = 0  # labels wanted
    made_from: str = ""  # houses, objects and robot
    labels: int = 0  # made by this job
    positives: int = 0  # of those
    shards: int = 0  # that were missing when the job began
    remaining: int = 0  # of those, still missing
    quarantined: tuple[int, ...] = ()
    retries: int = 0
    start_s: float = 0.0  # until the first shard began
    elapsed_s: float = 0.0  # from then on
    store: str = ""  # the sealed store, which zarr and xarray open
    cause: str = ""  # of an aborted job, and the most frequent one of a failed job
    resume: tuple[str, ...] = ()  # the words of the command that continues
    budget: str = ""  # as given
    forecast: Forecast | None = None  # of a dry run

    @property
    def complete(self) -> bool:
        """Whether the run has all labels that were wanted, but for the allowed share in quarantine."""
        return self.end == "complete"

    @property
    def exit_code(self) -> int:
        """The command line's exit status: 0 good, 1 too many failures, 2 aborted, 3 budget, 130 stopped."""
        return _EXIT_CODES[self.end]


def job_report(job: StoredJob) -> dict[str, Any]:
    """One job: its record, its last state, and its health."""
    record, state = job.record, job.state
    fields = state.model_dump(mode="json", exclude={"format_version", "id"}) if state else {}
    return {
        **record.model_dump(mode="json", exclude={"format_version"}),
        "health": job.health(),
        "heard_s": round(job.silence().total_seconds(), 1),
        "asked_to_stop": None if job.order is None else ("now" if job.order.now else "drain"),
        "state": fields,
    }


def health_line(job: StoredJob) -> str:
    """One line on a job: state, progress, host and process."""
    record, state, health = job.record, job.state, job.health()
    where = f"{record.host}, process {record.pid}"
    if record.submission:
        where += f", submitted as {record.submission}"
    if health == "ended" and state is not None:
        return f"ended {state.end}, exit code {state.exit_code} ({where})"
    heard = f"last sign {seconds(job.silence().total_seconds())} ago"
    if health == "dead":
        return f"dead: its process has ended, {heard} ({where})"
    if state is None or state.phase == "starting":
        return f"{'silent' if health == 'silent' else 'starting'}, {heard} ({where})"
    left = "?" if state.left_s is None else seconds(state.left_s)
    if state.left_80_s is not None:
        low_s, high_s = state.left_80_s
        left = shown_range(Interval(low_s, (low_s + high_s) / 2, high_s))
    doing = "sealing" if state.phase == "sealing" else f"{state.labels_per_s:,.1f} labels/s, {left} left"
    if state.stopping:
        doing = f"stopping, {state.in_flight} running"
    elif job.order is not None:
        doing += ", asked to stop"
    silent = "silent, " if health == "silent" else ""
    return f"{silent}{state.done} of {counted(state.shards, 'shard')}, {doing}, {heard} ({where})"


def print_job(result: JobResult, *, job: Mapping[str, Any] | None = None, **_: Any) -> int:
    """Print the summary of a job and return the exit code. `job` has the options of the job."""
    as_json = bool((job or {}).get("json"))
    if result.forecast is not None and as_json:
        print_json({"run": result.path, **result.forecast.record()})
    elif result.forecast is not None:
        print_forecast(result.path, result.forecast)
    elif result.end != "detached":  # `detach_job` has printed how to follow it
        _print(result)
        if result.end == "budget":
            _print_budget(result, as_json)
    return result.exit_code


def _print_budget(result: JobResult, as_json: bool) -> None:
    """Print on standard error that the budget is spent, and how to resume with another one."""
    if as_json:
        again = {"remaining": result.remaining, "exit_code": result.exit_code, "resume": list(result.resume)}
        values = {"event": "budget", "budget": result.budget, "labels": result.labels, **again}
        print_json(values, indent=None, to=sys.stderr)
        return
    left = counted(result.remaining, "shard")
    sys.stderr.write(f"budget of {result.budget} spent; {left} left. {resume_with(result.resume)}\n")


def _print(result: JobResult) -> None:
    n, path = result.n, result.path
    if result.shards:
        labels = f"{result.labels:,} new of {n:,} wanted"
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
        rows.append(("store", f"{result.store}: zarr.open or xarray.open_zarr reads it"))
    print_rows(f"{result.end}: {path}", rows)
    if result.end == "failed":
        most = f", most often by: {result.cause}" if result.cause else ""
        see = command_line(["status", path])
        sys.stderr.write(one_line(f"error: {path}: too many shards are quarantined{most}. See: {see}") + "\n")
    if result.end == "interrupted":
        print_interrupted(f"; {counted(result.remaining, 'shard')} left", result.resume)


def _time(result: JobResult) -> str:
    if not result.labels:
        return seconds(result.start_s + result.elapsed_s)
    rate = result.labels / max(result.elapsed_s, 1e-6)
    parts = f"start {seconds(result.start_s)}, labels {seconds(result.elapsed_s)}"
    return f"{seconds(result.start_s + result.elapsed_s)}: {parts} at {rate:,.0f}/s"

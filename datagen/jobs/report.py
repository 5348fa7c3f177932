"""Jobs of a place as plain values, and what their ends and silences mean in words."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

from datagen.console.command_lines import command_line, say_interrupted
from datagen.console.printing import counted, listed, print_rows, seconds
from datagen.jobs.job import JobInterrupted, JobResult
from datagen.schemas.errors import one_line
from datagen.schemas.jobs import Job, Jobs
from datagen.schemas.storage import Storage


def jobs_report(place: Storage) -> list[dict[str, Any]]:
    """Every job that began at the place, the oldest first."""
    return [job_report(job) for job in Jobs(place).all()]


def job_report(job: Job) -> dict[str, Any]:
    """One job: its record, its last state, and whether it lives."""
    record, state = job.record, job.state
    told = state.model_dump(mode="json", exclude={"format_version", "id"}) if state else {}
    return {
        **record.model_dump(mode="json", exclude={"format_version"}),
        "health": job.health(),
        "heard_s": round(job.silence().total_seconds(), 1),
        "asked_to_stop": None if job.order is None else ("now" if job.order.now else "drain"),
        "state": told,
    }


def health_line(job: Job) -> str:
    """One line: who it is, how it is."""
    record, state, health = job.record, job.state, job.health()
    where = f"{record.host}, process {record.pid}"
    if record.submission:
        where += f", submitted as {record.submission}"
    if health == "ended" and state is not None:
        return f"ended {state.end}, exit code {state.exit_code} ({where})"
    heard = f"heard {seconds(job.silence().total_seconds())} ago"
    if health == "dead":
        return f"dead: its process is gone, {heard} ({where})"
    if state is None or state.phase == "starting":
        return f"{'silent' if health == 'silent' else 'starting'}, {heard} ({where})"
    left = "?" if state.left_s is None else seconds(state.left_s)
    doing = "sealing" if state.phase == "sealing" else f"{state.labels_per_s:,.1f} labels/s, {left} left"
    if state.stopping:
        doing = f"stopping, {state.in_flight} in flight"
    elif job.order is not None:
        doing += ", asked to stop"
    silent = "silent, " if health == "silent" else ""
    return f"{silent}{state.done} of {counted(state.shards, 'shard')}, {doing}, {heard} ({where})"


def reported(job: Callable[[], JobResult]) -> int:
    """Run a job and print how it went, also where it was interrupted; the exit code."""
    try:
        result = job()
    except JobInterrupted as stopped:
        result = stopped.result
    if result.end != "detached":
        _print(result)
    return result.exit_code


def _print(result: JobResult) -> None:
    n, name = result.n, result.path
    if result.shards:
        labels = f"{result.labels:,} new, {n:,} wanted"
    elif result.quarantined:
        labels = f"nothing to do: the shards of {n:,} labels are made or given up"
    else:
        labels = f"nothing to do: all {n:,} labels are there"
    rows = [
        ("labels", labels),
        ("positive", f"{100 * result.positives / result.labels:.1f}%" if result.labels else "-"),
        ("time", _time(result)),
        ("retries", str(result.retries)),
    ]
    if result.quarantined:
        again = command_line(["resume", name, "--quarantined"])
        those = f"{counted(len(result.quarantined), 'shard')} ({listed(result.quarantined)})"
        rows.append(("quarantined", f"{those}: {again} tries again"))
    if result.store:
        rows.append(("store", f"{result.store}: zarr.open or xarray.open_zarr reads it"))
    print_rows(f"{result.end}: {name}", rows)
    if result.end == "failed":
        most = f", most often by: {result.cause}" if result.cause else ""
        see = command_line(["status", name])
        sys.stderr.write(one_line(f"error: {name}: too many shards failed{most}. See: {see}") + "\n")
    if result.end == "interrupted":
        say_interrupted(f" with {counted(result.remaining, 'shard')} to go", result.resume)


def _time(result: JobResult) -> str:
    if not result.labels:
        return seconds(result.start_s + result.elapsed_s)
    rate = result.labels / max(result.elapsed_s, 1e-6)
    parts = f"start {seconds(result.start_s)}, labels {seconds(result.elapsed_s)}"
    return f"{seconds(result.start_s + result.elapsed_s)}: {parts} at {rate:,.0f}/s"

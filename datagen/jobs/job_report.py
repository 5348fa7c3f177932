"""Jobs of a run as plain values and as lines of text."""

from __future__ import annotations

from typing import Any

from datagen.console.printing import counted, seconds
from datagen.schemas.jobs import Jobs, StoredJob
from datagen.schemas.storage import Storage


def jobs_report(place: Storage) -> list[dict[str, Any]]:
    """Every job of the run, the oldest first."""
    return [job_report(job) for job in Jobs(place).all()]


def job_report(job: StoredJob) -> dict[str, Any]:
    """One job: its record, its last state, and its health."""
    record, state = job.record, job.state
    told = state.model_dump(mode="json", exclude={"format_version", "id"}) if state else {}
    return {
        **record.model_dump(mode="json", exclude={"format_version"}),
        "health": job.health(),
        "heard_s": round(job.silence().total_seconds(), 1),
        "asked_to_stop": None if job.order is None else ("now" if job.order.now else "drain"),
        "state": told,
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
    doing = "sealing" if state.phase == "sealing" else f"{state.labels_per_s:,.1f} labels/s, {left} left"
    if state.stopping:
        doing = f"stopping, {state.in_flight} running"
    elif job.order is not None:
        doing += ", asked to stop"
    silent = "silent, " if health == "silent" else ""
    return f"{silent}{state.done} of {counted(state.shards, 'shard')}, {doing}, {heard} ({where})"

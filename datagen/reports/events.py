"""Events of a run from its records: jobs, failed attempts, retries, quarantined shards."""

from __future__ import annotations

from dataclasses import dataclass

from datagen.console.printing import counted
from datagen.schemas.jobs import Jobs
from datagen.schemas.quarantine import lifted_records
from datagen.schemas.run import Run, open_runs
from datagen.schemas.storage import Storage

_GOOD = ("committed", "superseded")


@dataclass(frozen=True)
class Event:
    """One event: time, kind, text and details."""

    at: str  # UTC, ISO 8601; "" where it is not known
    what: str
    text: str
    stack: str = ""
    shard: int | None = None


def events_of(storage: Storage) -> list[Event]:
    """Return the events of a run, or of merged runs, in order of time.

    Of attempts, those of shards that failed at least once and did not commit.
    """
    found, runs = _job_events(storage), open_runs(storage)
    for number, run in enumerate(runs):
        part = f"part {number}: " if len(runs) > 1 else ""
        found += _attempt_events(run, part) + _quarantine_events(run, part)
    return sorted(found, key=lambda event: event.at)


def _job_events(storage: Storage) -> list[Event]:
    events: list[Event] = []
    for job in Jobs(storage).all():
        record, state = job.record, job.state
        where = f"on {record.host}, process {record.pid}"
        if record.submission:
            where += f", submitted to Ray as {record.submission}"
        text = f"job {job.id} began {where}: {' '.join(record.command)}"
        events.append(Event(record.started, "job_began", text))
        if state is not None and state.end:
            why = f": {state.cause}" if state.cause else ""
            text = (
                f"job {job.id} ended {state.end}, exit code {state.exit_code}, {state.done} of "
                f"{counted(state.shards, 'shard')}, {counted(state.labels, 'label')}{why}"
            )
            events.append(Event(state.updated, "job_ended", text))
        elif job.health() == "dead":
            text = f"job {job.id} is dead: its process has ended; this was its last sign"
            last_seen = state.updated if state else record.started
            events.append(Event(last_seen, "job_dead", text))
    return events


def _attempt_events(run: Run, part: str) -> list[Event]:
    ends, events = {end.attempt: end for end in run.ledger.ends()}, list[Event]()
    bad = [end for end in ends.values() if end.outcome not in _GOOD]
    shards, ended = {end.shard for end in bad}, {end.attempt for end in bad}
    attempts = {end.attempt: end.shard for end in ends.values()}
    committed = {commit.attempt for commit in run.commits()}
    attempts |= {start.attempt: start.shard for start in run.ledger.unfinished(committed)}
    for attempt in sorted(attempt for attempt, shard in attempts.items() if shard in shards):
        start = run.ledger.start_of(attempt)
        if start is not None and start.started:  # else no worker began it, or the time is unknown
            text = f"{part}shard {start.shard} begins on {start.host or 'an unknown host'} ({attempt})"
            events.append(Event(start.started, "attempt_begins", text, "", start.shard))
        if attempt in ended:
            end = ends[attempt]
            cause = f": {end.cause}" if end.cause else ""
            text = f"{part}shard {end.shard} {end.outcome}{cause} ({attempt})"
            events.append(Event(end.ended, f"attempt_{end.outcome}", text, end.stack, end.shard))
    return events


def _quarantine_events(run: Run, part: str) -> list[Event]:
    events: list[Event] = []
    for lifted, records in ((False, run.quarantine_records()), (True, lifted_records(run))):
        for record in records:
            last = record.causes[-1] if record.causes else "unknown cause"
            note = " (tried again later)" if lifted else ""
            tried = counted(len(record.attempts), "attempt")
            text = f"{part}shard {record.shard} is quarantined after {tried}{note}: {last}"
            stack = record.stacks[-1] if record.stacks else ""
            events.append(Event(record.created, "quarantined", text, stack, record.shard))
    return events

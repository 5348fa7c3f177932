"""Events of a run from its records: jobs, failed attempts, retries, quarantined shards."""

from __future__ import annotations

from dataclasses import dataclass

from datagen.console.printing import counted
from datagen.schemas.jobs import Jobs
from datagen.schemas.merged_runs import open_runs
from datagen.schemas.quarantine import lifted_records
from datagen.schemas.run import Run
from datagen.schemas.storage import Storage
from datagen.schemas.summaries import Summaries

_GOOD = ("committed", "superseded")


@dataclass(frozen=True)
class Event:
    """One event: time, text and details. Events of equal key are the same."""

    at: str  # UTC, ISO 8601; "" where it is not known
    key: str  # of the record, and the kind of event
    what: str
    text: str
    stack: str = ""
    shard: int | None = None


_NOTHING = Event("", "", "", "")
# Events of the ledger by key: while events are followed, each is read once.
Known = dict[str, Event]


def events_of(storage: Storage, shard: int | None = None, known: Known | None = None) -> list[Event]:
    """Return the events of a run, or of merged runs, in order of time; `known` keeps those of the ledger."""
    known = {} if known is None else known
    found = _job_events(storage) if shard is None else []
    runs = open_runs(storage)
    for number, run in enumerate(runs):
        part = f"part {number}: " if len(runs) > 1 else ""
        found += _attempt_events(run, part, shard, known) + _quarantine_events(run, part, shard)
    return sorted(found, key=lambda event: (event.at, event.key))


def _job_events(storage: Storage) -> list[Event]:
    events: list[Event] = []
    for job in Jobs(storage).all():
        record, state, order = job.record, job.state, job.order
        where = f"on {record.host}, process {record.pid}"
        if record.submission:
            where += f", submitted to Ray as {record.submission}"
        text = f"job {job.id} began {where}: {' '.join(record.command)}"
        events.append(Event(record.started, f"{job.id} began", "job_began", text))
        if order is not None:
            how = "at once" if order.now else "after the running attempts"
            text = f"job {job.id} is asked to stop {how}, from {order.host}"
            events.append(Event(order.asked, f"{job.id} asked {order.now}", "stop_asked", text))
        if state is not None and state.end:
            why = f": {state.cause}" if state.cause else ""
            text = (
                f"job {job.id} ended {state.end}, exit code {state.exit_code}, {state.done} of "
                f"{counted(state.shards, 'shard')}, {counted(state.labels, 'label')}{why}"
            )
            events.append(Event(state.updated, f"{job.id} ended", "job_ended", text))
        elif job.health() == "dead":
            text = f"job {job.id} is dead: its process has ended; this was its last sign"
            last_seen = state.updated if state else record.started
            events.append(Event(last_seen, f"{job.id} dead", "job_dead", text))
    return events


def _attempt_events(run: Run, part: str, shard: int | None, known: Known) -> list[Event]:
    summaries, failed = Summaries(run), set[int]()
    ends, shards = list(summaries.ends()), {start.attempt: start.shard for start in summaries.unfinished()}
    for end in ends:
        shards[end.attempt] = end.shard
        if end.outcome not in _GOOD:
            failed.add(end.shard)
    wanted = failed if shard is None else {shard}
    found = {
        f"{run.storage.url} {end.attempt} {end.outcome}": (_end_event, end.attempt)
        for end in ends
        if end.shard in wanted and (shard is not None or end.outcome not in _GOOD)
    }
    for attempt in sorted(attempt for attempt, number in shards.items() if number in wanted):
        found[f"{run.storage.url} {attempt} begins"] = (_start_event, attempt)
    for key, (read, attempt) in found.items():
        if key not in known:
            known[key] = read(run, part, attempt, key)
    return [known[key] for key in found if known[key].what]


def _end_event(run: Run, part: str, attempt: str, key: str) -> Event:
    entry = run.ledger.end_of(attempt)
    if entry is None:
        return _NOTHING
    cause = f": {entry.cause}" if entry.cause else ""
    text = f"{part}shard {entry.shard} {entry.outcome}{cause} ({attempt})"
    return Event(entry.ended, key, f"attempt_{entry.outcome}", text, entry.stack, entry.shard)


def _start_event(run: Run, part: str, attempt: str, key: str) -> Event:
    start = run.ledger.start_of(attempt)
    if start is None or not start.started:  # no worker began it, or the time is unknown: its end is reported
        return _NOTHING
    text = f"{part}shard {start.shard} begins on {start.host or 'an unknown host'} ({attempt})"
    return Event(start.started, key, "attempt_begins", text, "", start.shard)


def _quarantine_events(run: Run, part: str, shard: int | None) -> list[Event]:
    events: list[Event] = []
    for lifted, records in ((False, run.quarantine_records()), (True, lifted_records(run))):
        for record in records:
            if shard is not None and record.shard != shard:
                continue
            last = record.causes[-1] if record.causes else "unknown cause"
            note = " (tried again later)" if lifted else ""
            tried = counted(len(record.attempts), "attempt")
            text = f"{part}shard {record.shard} is quarantined after {tried}{note}: {last}"
            key = f"{run.storage.url} {record.shard} given up {record.created}"
            stack = record.stacks[-1] if record.stacks else ""
            events.append(Event(record.created, key, "quarantined", text, stack, record.shard))
    return events

"""`datagen status`: progress of a run, its jobs and its failures; with --log, its events."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from typing import Any

from datagen.console.command_lines import command_line
from datagen.console.options import AsJson, RunPath
from datagen.console.printing import counted, listed, print_json, print_lines, print_rows
from datagen.jobs.job_report import health_line, job_report
from datagen.reports.run_status import runs_report
from datagen.schemas.errors import printable
from datagen.schemas.jobs import Jobs
from datagen.schemas.quarantine import lifted_records
from datagen.schemas.run import Run, open_runs
from datagen.schemas.storage import Storage, open_storage


def status(run: RunPath, /, *, log: bool = False, stacks: bool = False, json: AsJson = False) -> int:
    """Show the progress of a run: shards, labels, jobs, failed attempts by cause, and quarantine.

    For merged runs it shows the sums, and one line per part.

    For example: datagen status runs/first

    Args:
        log: List what happened instead, in order of time: jobs, failed attempts, retries, quarantined shards.
        stacks: Add the stack of each failure; without --log, one for each cause.
    """
    storage = open_storage(run, probe=False, create=False)
    if log:
        _print_log(storage, stacks, json)
        return 0
    report = runs_report(storage, stacks)
    if json:
        print_json(report | {"jobs": [job_report(job) for job in Jobs(storage).all()]})
    else:
        _print(run, storage, report)
    return 0


def _print_log(storage: Storage, stacks: bool, as_json: bool) -> None:
    events = events_of(storage)
    if as_json:
        rows = [{"at": e.at, "event": e.what, "text": e.text, "shard": e.shard} for e in events]
        if stacks:
            rows = [r | ({"stack": e.stack} if e.stack else {}) for r, e in zip(rows, events, strict=True)]
        print_json({"run": storage.url, "events": rows})
        return
    if not events:
        sys.stderr.write("no events: no job has begun and no attempt has failed\n")
    for event in events:
        at = event.at[:23].replace("T", " ") or "unknown time"
        print_lines(printable(f"{at}  {event.text}"))
        print_lines(event.stack if stacks else "", "    ")


def _print(name: str, storage: Storage, report: dict[str, Any]) -> None:
    shards = report["shards"]
    n_quarantined = len(shards["quarantined"])
    state = "complete" if report["complete"] else f"{counted(shards['missing'], 'shard')} missing"
    if n_quarantined:
        state += f", {n_quarantined} quarantined ({listed(shards['quarantined'])})"
    attempts = ", ".join(f"{outcome} {count}" for outcome, count in report["attempts"].items()) or "none"
    rows = [
        ("labels", f"{report['labels']:,} of {report['n']:,} ({report['label_source']})"),
        ("made from", report["made_from"]),
        ("shards", f"{shards['committed']} of {shards['planned']} committed; {state}"),
        ("attempts", attempts),
        ("sealed", _seal(report)),
        ("specification", report["spec_hash"][:16] or "one per part"),
        ("created", report["created"]),
    ]
    if report["scenes_from"]:
        rows.append(("scenes from", report["scenes_from"]))
    if report["attempts_without_end"]:
        without = counted(report["attempts_without_end"], "attempt")
        rows.insert(3, ("unfinished", f"{without}: running or lost"))
    print_rows(name, rows)
    jobs = Jobs(storage).all()
    # The jobs that may be running, or else the latest.
    if shown := [job for job in jobs if job.health() in ("live", "silent")] or jobs[-1:]:
        print_rows("jobs", [(job.id, health_line(job)) for job in shown])
    parts = [
        (
            part["run"].rsplit("/", 1)[-1],
            f"{part['labels']:,} of {part['n']:,}",
            f"{part['shards']['committed']} of {part['shards']['planned']}",
            str(len(part["shards"]["quarantined"])),
        )
        for part in report.get("parts", ())
    ]
    print_rows("parts", parts, ("part", "labels", "shards", "quarantined"))
    _print_failures(name, report)


def _print_failures(name: str, report: dict[str, Any]) -> None:
    causes = [(cause, str(n)) for cause, n in report["causes"].items()]
    print_rows("causes", causes, ("cause", "attempts"))
    for cause, stack in report.get("stacks", {}).items():
        print_rows(cause, [(line, "") for line in stack.splitlines()])
    if quarantine := report["quarantine"]:
        rows = [(str(q["shard"]), str(q["attempts"]), q["cause"]) for q in quarantine[:20]]
        print_rows("quarantined", rows, ("shard", "attempts", "last cause"))
        again = command_line(["resume", name, "--quarantined"])
        print_rows(f"Try them again: {again}", [])


def _seal(report: dict[str, Any]) -> str:
    if report["sealed"]:
        return f"yes, {report['store']}"
    if report["sealed_labels"] is None:
        return "no"
    outdated = f"{report['store']} is out of date ({report['sealed_labels']:,} labels)"
    how = "resume" if report["shards"]["missing"] else "verify --repair"
    return f"{outdated}: `datagen {how}` seals it"


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
        text = f"job {job.id} began {where}: {shlex.join(record.command)}"
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

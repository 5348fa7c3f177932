"""`datagen status`: progress of a run, its jobs and its failures; with --log, its events."""

from __future__ import annotations

import sys
from typing import Any

from datagen.console.command_lines import command_line
from datagen.console.options import AsJson, RunPath
from datagen.console.printing import counted, listed, print_json, print_lines, print_rows
from datagen.jobs.job_report import health_line, job_report
from datagen.reports.events import events_of
from datagen.reports.run_status import runs_report
from datagen.schemas.errors import printable
from datagen.schemas.jobs import Jobs
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
    return f"{outdated}: `datagen verify --repair` seals it"

"""`datagen logs`: events of a run in order of time."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from typing import Any

from datagen.console.options import RunPath, Whole
from datagen.console.printing import print_json, print_lines
from datagen.jobs.detach import jobs_api_of
from datagen.reports.events import Event, Known, events_of
from datagen.schemas.errors import InputError, printable
from datagen.schemas.jobs import Jobs
from datagen.schemas.merged_runs import open_runs
from datagen.schemas.storage import Storage, open_storage

_POLL_S = 2.0


def logs(
    run: RunPath,
    /,
    *,
    follow: bool = False,
    shard: Whole | None = None,
    stacks: bool = False,
    driver: bool = False,
    json: bool = False,
) -> int:
    """List events of a run: jobs that began and ended, failed attempts, retries, quarantined shards.

    Successful attempts are listed with --shard only; `datagen status` counts them.

    For example: datagen logs runs/first --follow

    Args:
        follow: Wait for new events while a job is running.
        shard: All events of one shard, successful attempts included.
        stacks: Add the stack of each failure.
        driver: Output of the driver of the latest detached job.
        json: Print one JSON object per line.
    """
    storage = open_storage(run, probe=False, create=False)
    runs = open_runs(storage)
    if shard is not None and not any(shard in part.planned() for part in runs):
        last = max(len(part.planned()) for part in runs) - 1
        raise InputError(run, "--shard", f"{shard} is not in this run", f"Give one from 0 to {last}")
    if driver:
        return _print_driver(storage, follow)
    printed = 0
    for event in _new_events(storage, shard, follow):
        _print(event, stacks, json)
        printed += 1
    if not printed:
        reason = "no job has begun and no attempt has failed" if shard is None else "the shard has not begun"
        sys.stderr.write(f"no events: {reason}\n")
    return 0


def _new_events(storage: Storage, shard: int | None, follow: bool) -> Iterator[Event]:
    seen, known = set[str](), Known()
    while True:
        # Checked before the events are read, so that the last ones are not missed.
        live = follow and any(job.health() == "live" for job in Jobs(storage).all())
        for event in events_of(storage, shard, known):
            if event.key not in seen:
                seen.add(event.key)
                yield event
        if not live:
            return
        time.sleep(_POLL_S)


def _print(event: Event, stacks: bool, as_json: bool) -> None:
    if as_json:
        fields: dict[str, Any] = {"at": event.at, "event": event.what, "text": event.text}
        if event.shard is not None:
            fields["shard"] = event.shard
        if event.stack and stacks:
            fields["stack"] = event.stack
        print_json(fields, indent=None)
    else:
        at = event.at[:23].replace("T", " ") or "unknown time"
        print_lines(printable(f"{at}  {event.text}"))
        if event.stack and stacks:
            print_lines(event.stack, "    ")
    sys.stdout.flush()


def _print_driver(storage: Storage, follow: bool) -> int:
    """Print the output of the latest detached job, as Ray keeps it."""
    detached = [job for job in Jobs(storage).all() if job.record.submission]
    if not detached:
        problem = "no job of this run was detached; others write to their terminals"
        raise InputError(storage.url, "jobs", problem, "Omit --driver")
    record = detached[-1].record
    ray, printed = jobs_api_of(record.jobs_api), 0
    while True:
        live = follow and ray.state(record.submission) in ("PENDING", "RUNNING")
        output = ray.output(record.submission)
        # A line that is still being written is printed when it is complete.
        whole = output.rfind("\n") + 1 if live else len(output)
        print_lines(output[printed:whole])
        printed = max(printed, whole)
        if not live:
            return 0
        time.sleep(_POLL_S)

"""Run one shard in this process without catching exceptions, for debuggers and tracebacks."""

from __future__ import annotations

import faulthandler
import shlex
import sys
import traceback
from hashlib import sha256
from typing import Any

from datagen.console.printing import print_json, print_lines, print_rows
from datagen.regeneration.scenes import OpenedSources, regenerate_shard, regenerated_files
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.run_records import QuarantineRecord
from datagen.workers.run_shard import ShardResult


class ShardFailed(Exception):
    """A replayed shard failed. This is a defect and not bad input, so it keeps its traceback."""


def replay_shard(path: str, run: Run, shard: int, origin: OpenedSources, json: bool = False) -> int:
    """Print the shard's recorded failures, and make it again; return the exit code.

    Exceptions of the computation are not caught; an InputError is wrapped in `ShardFailed`. The shard is
    compared with its committed files, if any. No file is written.
    """
    planned = run.planned()
    if shard not in planned:
        fix = f"Give one from 0 to {len(planned) - 1}"
        raise InputError(path, "--shard", f"{shard} is not in this run", fix)
    record = next((r for r in run.quarantine_records() if r.shard == shard), None)
    failed = _recorded(run, shard, record)
    if not json:
        _print_recorded(path, shard, record, failed)
    if sys.__stderr__ is not None:
        faulthandler.enable(sys.__stderr__)  # also prints the stack of a native crash
    made = _make(run, shard, origin)
    differing = _differing_files(run, shard, made)
    report: dict[str, Any] = {
        "run": run.storage.url,
        "shard": shard,
        "recorded": failed,
        "labels": len(made.sample["label"]),
        "positives": int(made.sample["label"].sum()),
        "committed": differing is not None,
        "differing_files": differing or [],
        "quarantined": record is not None,
        "fix": None if record is None else f"datagen resume {shlex.quote(path)} --quarantined",
    }
    if json:
        print_json(report)
    else:
        _print_made(path, report)
    return 1 if differing else 0


def _make(run: Run, shard: int, origin: OpenedSources) -> ShardResult:
    try:
        return regenerate_shard(run, shard, origin)
    except InputError as error:
        # The command line would reduce it to one line and hide where it was raised.
        raise ShardFailed(str(error)) from error
    except KeyboardInterrupt:
        traceback.print_exc()  # where it hung
        raise


def _differing_files(run: Run, shard: int, made: ShardResult) -> list[str] | None:
    """Files of the shard that differ from the committed ones; None where it is not committed."""
    if shard not in run.committed():
        return None
    entries = {entry.path: entry.sha256 for entry in run.commit_of(shard).files}
    files = {path: sha256(data).hexdigest() for path, data in regenerated_files(run, made).items()}
    return sorted(path for path in {*entries, *files} if entries.get(path) != files.get(path))


def _recorded(run: Run, shard: int, record: QuarantineRecord | None) -> list[dict[str, str]]:
    """Failed attempts of the shard: attempt, outcome, cause, stack."""
    if record is not None and record.causes:
        each = zip(record.attempts, record.causes, record.stacks, strict=False)
        return [{"attempt": a, "cause": c, "stack": s} for a, c, s in each]
    return [
        {"attempt": end.attempt, "cause": f"{end.outcome}: {end.cause}", "stack": end.stack}
        for end in run.ledger.ends()
        if end.shard == shard and end.outcome not in ("committed", "superseded", "cancelled")
    ]


def _print_recorded(
    path: str, shard: int, record: QuarantineRecord | None, failed: list[dict[str, str]]
) -> None:
    state = "" if record is None else f", quarantined at {record.created}"
    print_rows(f"shard {shard} of {path}{state}", [(f["attempt"], f["cause"]) for f in failed])
    stacks = [f["stack"].rstrip() for f in failed if f["stack"].strip()]
    if stacks:
        print_lines(f"the last recorded stack:\n{stacks[-1]}")
    print_lines("now on this machine:")


def _print_made(path: str, report: dict[str, Any]) -> None:
    rows = [("made", f"{report['labels']} labels, {report['positives']} positive; no file was written")]
    if report["committed"]:
        differing = report["differing_files"]
        result = "equal, bit for bit" if not differing else f"{len(differing)} differ, first {differing[0]}"
        rows.append(("committed files", result))
    if report["fix"]:
        rows.append(("to try it again", report["fix"]))
    print_rows(f"shard {report['shard']} of {path}: runs without failure", rows)

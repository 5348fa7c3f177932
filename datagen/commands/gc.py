"""`datagen gc`: remove files of a run that no commit names."""

from __future__ import annotations

import re
import shlex
import time
from typing import Any

from datagen.cluster.run_recorder import refresh_index
from datagen.console.options import AsJson, RunPath
from datagen.console.printing import print_json, print_rows, size
from datagen.display.progress import counting
from datagen.schemas.errors import InputError
from datagen.schemas.garbage_collection import KINDS, Garbage, Seen, Swept, find_garbage, sweep
from datagen.schemas.merged_runs import open_runs
from datagen.schemas.storage import Storage, open_storage

_AGE = re.compile(r"([0-9]{1,9})(s|m|h|d)")
_UNIT_S = {"s": 1, "m": 60, "h": 3600, "d": 86400}
_SHOWN = 100


def gc(run: RunPath, /, *, older_than: str = "24h", dry_run: bool = False, json: AsJson = False) -> int:
    """Remove files that no commit names: of superseded or unfinished attempts, drafts and probes.

    Committed files and records of the ledger are never removed, nor are files of attempts that began after
    the first running job. It may run while jobs run; after an interruption, run it again.

    For example: datagen gc runs/first --dry-run

    Args:
        older_than: Keep files newer than this: 90s, 30m, 24h or 7d. It must exceed the duration of a
            merge that is running: with 0s the merge loses files and must be run again.
        dry_run: List the files, but remove nothing.
    """
    storage = open_storage(run, probe=False, create=False)
    age_s = age_of(older_than)
    with counting("shards searched", as_json=json) as seen:
        garbage = find_garbage(storage, age_s, time.time(), seen)
    swept = Swept()
    if not dry_run:
        with counting("items removed", as_json=json) as seen:
            swept = remove(storage, garbage, seen)
    report = gc_report(storage, garbage, swept, dry_run)
    if json:
        print_json(report)
    else:
        _print(run, report)
    return 1 if swept.damaged else 0


def age_of(text: str) -> float:
    """Return the seconds of an age like 24h. Raises InputError for anything else."""
    found = _AGE.fullmatch(text.strip())
    if found is None:
        raise InputError("--older-than", text, "is not an age", "Give a number of s, m, h or d, like 24h")
    return int(found[1]) * _UNIT_S[found[2]]


def remove(storage: Storage, garbage: list[Garbage], seen: Seen = lambda done, of: None) -> Swept:
    """Remove the garbage, and update the indices of the runs."""
    total = Swept()
    for done, piece in enumerate(garbage):
        seen(done, len(garbage))
        total = total.plus(sweep(piece))
    for run in open_runs(storage):
        refresh_index(run)
    return total


def gc_report(storage: Storage, garbage: list[Garbage], swept: Swept, dry_run: bool) -> dict[str, Any]:
    """Return what was found and removed, as plain values; sizes in bytes."""
    of_kind = {kind: [piece for piece in garbage if piece.kind == kind] for kind in KINDS}
    return {
        "run": storage.url,
        "dry_run": dry_run,
        "found": {
            kind: {"pieces": len(of), "files": sum(p.files for p in of), "bytes": sum(p.bytes for p in of)}
            for kind, of in of_kind.items()
        },
        "removed": {"files": swept.files, "bytes": swept.bytes},
        "committed_meanwhile": swept.spared,
        "damaged": list(swept.damaged),
        "first": [f"{piece.storage.url}/{piece.key}" for piece in garbage[:_SHOWN]],
    }


def _print(path: str, report: dict[str, Any]) -> None:
    rows = [
        (kind, str(found["pieces"]), str(found["files"]), size(found["bytes"]))
        for kind, found in report["found"].items()
    ]
    done = "would be removed" if report["dry_run"] else "removed"
    print_rows(f"{done} from {path}", rows, ("kind", "pieces", "files", "size"))
    if report["committed_meanwhile"]:
        print_rows("committed meanwhile and kept", [("attempts", str(report["committed_meanwhile"]))])
    fix = f"datagen repair {shlex.quote(path)}"
    rows = [(key, fix) for key in report["damaged"][:_SHOWN]]
    print_rows("committed while their files were removed", rows, ("commit", "fix"))

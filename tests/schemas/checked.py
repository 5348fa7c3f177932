"""What tests of checks share: a sealed run of two shards, what checks find in it, and records edited."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from datagen.schemas.checking.check_runs import Checked, check_runs
from datagen.schemas.checking.finding import Finding
from datagen.schemas.record_files import signed_json
from datagen.schemas.run import Run
from datagen.schemas.run_records import Cost, LedgerEntry
from datagen.schemas.sealing import seal
from datagen.schemas.storage import open_storage
from tests.made_runs import make_run


def check(folder: Path) -> tuple[list[Finding], Checked]:
    checked = Checked()
    return list(check_runs(open_storage(folder, probe=False, create=False), checked)), checked


def found(folder: Path) -> list[tuple[str, str]]:
    """(kind, file) of every finding."""
    return [(f.kind, f.key) for f in check(folder)[0]]


def edit(path: Path, **changes: Any) -> None:
    """Change a record and sign it anew, as one who knows the format would."""
    record = json.loads(path.read_text())
    del record["sha256"]
    path.write_bytes(signed_json(record | changes))


def sealed_run(folder: Path) -> Run:
    """A sealed run of two shards and one failed attempt."""
    run = make_run(folder, 19)
    run.ledger.end(LedgerEntry(attempt="x-1", shard=1, outcome="crashed", cost=Cost(wall_s=2, cpu_s=1)))
    seal(run.storage)
    return run


def folder_of(run: Run) -> Path:
    assert run.storage.folder is not None
    return run.storage.folder

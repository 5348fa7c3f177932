"""The operations that are killed at every call, and what a reader sees of a run: its units."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path

from cluster.books import close_lost_attempts
from schemas.errors import InputError
from schemas.fields import SCHEMAS, RecordSchema
from schemas.merged import MERGED, open_runs, part_folder
from schemas.record_files import encode_record
from schemas.run import Run
from schemas.run_records import Layout, LedgerEntry, Merged, QuarantineRecord
from schemas.seal import SEALED, seal, unseal
from schemas.storage import open_storage
from tests.made_runs import attempt, make_run, manifest_of, small_spec

# A shard of few files, so that every call of every operation can be tried. All that these tests and the
# code below them need of a schema is there: names, texts, a vector, both tables.
_KEPT = ("scene_index", "house_id", "redraws", "sample_id", "sample_scene_index", "candidate_index", "label")

Units = dict[str, str]


@dataclass(frozen=True)
class Operation:
    """`prepare` makes what is there before, in a new folder; `act` is what is killed; `resume` is what
    the user does then (the same again, where it is not given)."""

    name: str
    prepare: Callable[[Path], None]
    act: Callable[[Path], None]
    resume: Callable[[Path], None] | None = None


def small_schema() -> RecordSchema:
    """The schema of these shards, for `SCHEMAS["heuristic"]`."""
    schema = SCHEMAS["heuristic"]
    return replace(
        schema,
        scene_fields=tuple(f for f in schema.scene_fields if f.name in _KEPT),
        sample_fields=tuple(f for f in schema.sample_fields if f.name in _KEPT),
    )


def units(folder: Path) -> Units:
    """What readers see of a run or of merged runs, unit by unit; each must be as before or as after.

    A record that is refused, or a shard whose bytes are not those committed, is a unit of its own value.
    """
    place = open_storage(folder, probe=False)
    found: Units = {"sealed": _sealed(folder)}
    if not (folder / MERGED).exists() and not (folder / "manifest.json").exists():
        return found
    for run in open_runs(place):
        name = run.manifest.spec_hash[:8]
        found[f"{name} manifest"] = sha256(run.storage.get("manifest.json", 2**20) or b"").hexdigest()
        if run.n:
            found[f"{name} n"] = str(run.n)
        for shard in sorted(run.committed()):
            found[f"{name} commit {shard}"] = _commit(run, shard)
        found[f"{name} quarantine"] = str(sorted(run.quarantined()))
        for entry in run.ledger.ends():
            found[f"ledger {name} end {entry.attempt}"] = entry.outcome
        for start in run.ledger.unfinished():
            found[f"ledger {name} begun {start.attempt}"] = str(start.shard)
    return found


def _commit(run: Run, shard: int) -> str:
    try:
        commit = run.commit_of(shard)
        run.check_digests(commit)
    except InputError as e:
        return f"refused: {e.problem}"
    rows = sorted((entry.path, entry.sha256) for entry in commit.files)
    return sha256(json.dumps(rows).encode()).hexdigest()


def _sealed(folder: Path) -> str:
    store = folder / SEALED
    if not store.exists():
        return ""
    digest = sha256()
    for path in sorted(p for p in store.rglob("*") if p.is_file()):
        digest.update(f"{path.relative_to(store)} {sha256(path.read_bytes()).hexdigest()}\n".encode())
    return digest.hexdigest()


# Operations ----------------------------------------------------------------------------------


def _create(folder: Path) -> None:
    layout = Layout(scenes_per_shard=2, candidates_per_scene=5)
    manifest = manifest_of(small_spec(), layout).model_copy(update={"created": "2026-01-01"})
    Run.create_or_open(open_storage(folder), manifest, 20)


def _make_anew(folder: Path, shard: int, name: str) -> None:
    run = Run.open(folder)
    if shard not in run.committed():
        attempt(run, shard, name)
    close_lost_attempts(run)


def _guess(folder: Path) -> None:
    run = make_run(folder, 20, shards=[0])
    run.ledger.start("b", 1)
    run.ledger.end(LedgerEntry(attempt="b", shard=1, outcome="lost", cause="no sign of it"))


def _account(folder: Path) -> None:
    run = Run.open(folder)
    known = next(entry for entry in run.ledger.ends() if entry.attempt == "a-0")
    run.ledger.end(LedgerEntry(attempt="b", shard=1, outcome="failed", cause="a cause", cost=known.cost))


def _give_up(folder: Path) -> None:
    record = QuarantineRecord(
        shard=1,
        seed=0,
        first_scene=2,
        scenes=2,
        attempts=("b",),
        causes=("c",),
        stacks=("s",),
        created="2026-01-01",
    )
    Run.open(folder).quarantine(record)


def _sealed_and_grown(folder: Path) -> None:
    seal(make_run(folder, 15).storage)
    make_run(folder, 33)


def _merged(folder: Path) -> None:
    specs = sorted((small_spec(0), small_spec(1)), key=lambda spec: spec.hash())
    for spec in specs:
        make_run(folder / part_folder(spec.hash()), 15, spec=spec)
    open_storage(folder).put_new(MERGED, encode_record(Merged(parts=tuple(spec.hash() for spec in specs))))


def _run(folder: Path, n: int, shards: list[int] | None) -> None:
    make_run(folder, n, shards=shards)


def _seal(folder: Path) -> None:
    seal(open_storage(folder, probe=False))


OPERATIONS = (
    Operation("create", lambda folder: folder.mkdir(), _create),
    Operation("grow", lambda folder: _run(folder, 20, [0, 1]), lambda folder: Run.open(folder).grow(35)),
    Operation(
        "attempt",
        lambda folder: _run(folder, 30, [0]),
        lambda folder: _make_anew(folder, 1, "b"),
        lambda folder: _make_anew(folder, 1, "c"),
    ),
    Operation("account", _guess, _account),
    Operation("quarantine", lambda folder: _run(folder, 20, [0]), _give_up),
    Operation("seal", lambda folder: _run(folder, 15, None), _seal),
    Operation("seal again", _sealed_and_grown, _seal),
    Operation("seal merged", _merged, _seal),
    Operation("unseal", _sealed_and_grown, lambda folder: unseal(open_storage(folder, probe=False))),
)

"""The operations that are killed at every call, and what a reader sees of a run: its units."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from uuid import uuid4

from datagen.jobs.relabelling import relabel_run, relabelled_specification
from datagen.schemas.checking.check_runs import Checked, check_runs
from datagen.schemas.checking.repair import clean_runs, repair_runs
from datagen.schemas.errors import InputError
from datagen.schemas.fields import SCHEMAS, RecordSchema
from datagen.schemas.merging import merge_runs, plan_merge
from datagen.schemas.record_files import MERGED
from datagen.schemas.run import Run, open_runs
from datagen.schemas.run_records import Layout, LedgerEntry, QuarantineRecord
from datagen.schemas.sealing import SEALED, seal, store_record
from datagen.schemas.storage import open_storage
from tests.made_runs import attempt, files_of, flip, make_run, manifest_of, small_spec, write

# A shard of few files, so that every call of every operation can be tried. All that these tests and the
# code below them need of a schema is there: names, texts, a vector, both tables.
_KEPT = ("scene_index", "house_id", "redraws", "sample_id", "sample_scene_index", "candidate_index", "label")
_KEPT_TO_RELABEL = (
    *("distance_m", "mount_distance_m", "arm_reach_m", "visibility", "heuristic_score", "label_version"),
    *("sample_id", "sample_scene_index", "candidate_index", "label", "scene_index", "redraws"),
)

LAYOUT = Layout(scenes_per_shard=2, candidates_per_scene=5)  # that of `make_run`
Units = dict[str, str]
_HEURISTIC = SCHEMAS["heuristic"]


@dataclass(frozen=True)
class Operation:
    """`prepare` makes what is there before, in a new folder; `act` is what is killed; `resume` is what
    the user does then (the same again, where it is not given). `places` are the runs in the folder;
    `exact` operations, resumed, leave the very files that they leave undisturbed."""

    name: str
    prepare: Callable[[Path], None]
    act: Callable[[Path], None]
    resume: Callable[[Path], None] | None = None
    places: tuple[str, ...] = ("",)
    fields: tuple[str, ...] = _KEPT
    exact: bool = False


def small_schema(fields: Iterable[str] = _KEPT) -> RecordSchema:
    """A schema of few of the fields of heuristic runs, to stand for theirs in `SCHEMAS`."""
    kept = set(fields)
    return replace(
        _HEURISTIC,
        scene_fields=tuple(f for f in _HEURISTIC.scene_fields if f.name in kept),
        sample_fields=tuple(f for f in _HEURISTIC.sample_fields if f.name in kept),
    )


def units(folder: Path, places: Iterable[str] = ("",)) -> Units:
    """What readers see of runs or of merged runs, unit by unit; each must be as before or as after.

    A record that is refused, or a shard whose bytes are not those committed, is a unit of its own value.
    """
    return {f"{place}:{name}": value for place in places for name, value in _units(folder / place).items()}


def _units(folder: Path) -> Units:
    found = {"sealed": _sealed(folder)}
    if not (folder / MERGED).exists() and not (folder / "manifest.json").exists():
        return found
    try:
        runs = open_runs(open_storage(folder, probe=False))
    except InputError as e:
        return found | {"refused": e.problem}
    for run in runs:
        name, size = run.manifest.spec_hash[:8], run.layout.scenes_per_shard
        name = f"{name}-{size}"
        found[f"{name} manifest"] = f"{run.manifest.spec_hash} {run.layout} {run.scenes}"
        if run.n:
            found[f"{name} n"] = str(run.n)
        attempts: set[str] = set()
        for shard in sorted(run.committed()):
            found[f"{name} commit {shard}"] = _commit(run, shard, attempts)
        found[f"{name} quarantine"] = str(sorted(run.quarantined()))
        for entry in run.ledger.ends():
            found[f"ledger {name} end {entry.attempt}"] = entry.outcome
        for start in run.ledger.unfinished(attempts):
            found[f"ledger {name} begun {start.attempt}"] = str(start.shard)
    return found


def damage(folder: Path, places: Iterable[str] = ("",)) -> list[str]:
    """What `verify` finds. Until it is resumed, an operation that was killed may lack a second copy."""
    return [
        f"{place}: {finding.key}: {finding.problem}"
        for place in places
        if (folder / place).exists()
        for finding in check_runs(open_storage(folder / place, probe=False), Checked())
        if finding.kind != "stale"
    ]


def _commit(run: Run, shard: int, attempts: set[str]) -> str:
    try:
        commit = run.commit_of(shard)
        attempts.add(commit.attempt)
        return sha256(run.read_object(commit)).hexdigest()
    except InputError as e:
        return f"refused: {e.problem}"


def _sealed(folder: Path) -> str:
    """The digest of the files of the store that counts, if undamaged, whatever its name; else ""."""
    try:
        record = store_record(open_storage(folder, probe=False)) if folder.exists() else None
    except InputError as e:
        return f"refused: {e.problem}"
    found = files_of(folder / record.name) if record else {}
    digests = {path: sha256(data).hexdigest() for path, data in found.items()}
    whole = record is not None and digests == {entry.path: entry.sha256 for entry in record.files}
    return sha256(json.dumps(digests, sort_keys=True).encode()).hexdigest() if whole else ""


# Operations ----------------------------------------------------------------------------------


def _create(folder: Path) -> None:
    manifest = manifest_of(small_spec(), LAYOUT).model_copy(update={"created": "2026-01-01"})
    Run.create_or_open(open_storage(folder), manifest, 20)


def _make_anew(folder: Path, shard: int, name: str) -> None:
    run = Run.open(folder)
    if shard not in run.committed():
        attempt(run, shard, name)
    run.close_lost_attempts()


def _guess(folder: Path) -> None:
    run = make_run(folder, 20, shards=[0])
    run.ledger.start("b", 1)
    run.ledger.end(LedgerEntry(attempt="b", shard=1, outcome="lost", cause="no sign of it"))


def _account(folder: Path) -> None:
    run = Run.open(folder)
    cost = run.commit_of(0).cost
    run.ledger.end(LedgerEntry(attempt="b", shard=1, outcome="failed", cause="a cause", cost=cost))


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


def _run(folder: Path, n: int, shards: list[int] | None) -> None:
    make_run(folder, n, shards=shards)


def _seal(folder: Path) -> None:
    seal(open_storage(folder, probe=False))


def _apart(folder: Path, seeds: tuple[int, int] = (0, 0), sizes: tuple[int, int] = (2, 2)) -> None:
    for name, seed, size, shards in (("a", seeds[0], sizes[0], [0, 1]), ("b", seeds[1], sizes[1], [1, 2])):
        run = make_run(folder / name, 30, size, shards=[], spec=small_spec(seed))
        for shard in shards:
            attempt(run, shard, f"{name}-{shard}")


def _merge(folder: Path) -> None:
    merge_runs(plan_merge([str(folder / "a"), str(folder / "b")], str(folder / "out")))


def _merged_and_grown(folder: Path) -> None:
    _apart(folder, (0, 1))
    _merge(folder)
    for run in open_runs(folder / "out"):
        for shard in run.missing():
            attempt(run, shard, f"c-{shard}")


def _damaged_records(folder: Path) -> None:
    run = make_run(folder, 30)
    run.ledger.start("lost", 0)
    flip(folder / "commits/000001.json")
    (folder / "copies/manifest.json").unlink()
    (folder / "ledger/a-2.start.json").unlink()
    (folder / "copies/plans/1.json").write_bytes(b"")


def _damaged_store(folder: Path) -> None:
    seal(make_run(folder, 20).storage)
    flip(folder / SEALED / "house_id/zarr.json")


def _damaged_manifest(folder: Path) -> None:
    make_run(folder, 20)
    flip(folder / "manifest.json")


def _damaged_files(folder: Path) -> None:
    seal(make_run(folder, 30).storage)
    flip(folder / "shards/a-1.zip")
    (folder / "shards/a-2.zip").unlink()


def _repair_and_resume(folder: Path) -> None:
    repair_runs(open_storage(folder, probe=False))
    remake(folder)
    _repair(folder)


def remake(folder: Path) -> None:
    """Make the missing shards, close what was left open, and seal, as `datagen resume` does."""
    storage = open_storage(folder, probe=False, create=False)
    for run in open_runs(storage):
        for shard in run.missing():
            attempt(run, shard, f"again-{shard}-{uuid4().hex[:8]}")
        run.close_lost_attempts()
    seal(storage)


def _repair(folder: Path) -> None:
    repaired = repair_runs(open_storage(folder, probe=False))
    for finding in repaired.left:
        raise InputError(finding.key, "", finding.problem, finding.fix)  # the command ends with 1


def _littered(folder: Path) -> None:
    run = make_run(folder, 30, shards=[0, 1])
    write(run, 1, "loser")
    write(run, 2, "late")
    for array in ("label", "rgb"):
        (folder / SEALED / array).mkdir(parents=True)
        (folder / SEALED / array / "c.0").write_bytes(b"1")
    (folder / f"commits/000002.json.{7:016x}.part").write_bytes(b"{}")


def _clean(folder: Path) -> None:
    clean_runs(open_storage(folder, probe=False), kept_s=-60)


def _relabelled(folder: Path) -> None:
    make_run(folder / "a", 30, shards=[0, 2], spec=small_spec(engines={"labels": "1"}))


def _relabel(folder: Path) -> None:
    source = Run.open(folder / "a")
    spec = relabelled_specification(source, {"heuristic.tau": 0.5})
    done = relabel_run(open_storage(folder / "out"), source, spec, json=True)
    if done.end != "complete":
        raise InputError(folder / "out", "", done.cause, "Again")


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
    Operation("seal merged", _merged_and_grown, lambda f: _seal(f / "out"), places=("out",)),
    Operation("merge one", _apart, _merge, places=("out",)),
    Operation("merge several", lambda f: _apart(f, (0, 1)), _merge, places=("out",)),
    Operation("merge sizes", lambda f: _apart(f, sizes=(2, 1)), _merge, places=("out",)),
    Operation("repair manifest", _damaged_manifest, _repair),
    Operation("repair records", _damaged_records, _repair),
    Operation("repair store", _damaged_store, _repair),
    Operation("repair files", _damaged_files, _repair_and_resume),
    Operation("clean", _littered, _clean, exact=True),
    Operation("relabel", _relabelled, _relabel, places=("out",), fields=_KEPT_TO_RELABEL),
)

"""Checks find nothing in sound runs, and records that are signed but wrong; test_damage.py damages bytes."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.schemas.checking.finding import Finding, SetAside
from datagen.schemas.errors import InputError
from datagen.schemas.fields import RecordSchema
from datagen.schemas.jobs import JobRecord, Jobs, JobState, new_job_id
from datagen.schemas.record_files import (
    commit_key,
    decode_record,
    encode_record,
    lost_end,
    signed_json,
    utc_now,
)  # fmt: skip
from datagen.schemas.run import Run
from datagen.schemas.run_records import AttemptStart, Cost, LedgerEntry, Plan, QuarantineRecord
from datagen.schemas.shard_files import encode_shard
from tests.made_runs import attempt, make_run, rows_of
from tests.schemas.checked import (
    check,
    commit_object,
    edit,
    encoded,
    fill,
    folder_of,
    found,
    merge,
    sealed_run,
)  # fmt: skip

pytestmark = pytest.mark.usefixtures("few_arrays")
COST = Cost(wall_s=3.0, cpu_s=2.0)
QUARANTINED = QuarantineRecord(
    shard=3, seed=0, first_scene=6, scenes=2, attempts=(), causes=(), stacks=(), created=""
)


@pytest.fixture
def sealed(tmp_path: Path) -> Run:
    return sealed_run(tmp_path / "run")


@pytest.fixture
def merged(tmp_path: Path) -> Path:
    """Merged runs of two specifications, one of them in shards of two sizes."""
    for who, size, seed, shards in (("a", 2, 1, [0, 1]), ("b", 3, 1, [0]), ("c", 2, 2, [0, 1])):
        fill(tmp_path, who, shards, 20, size, seed)
    merge(tmp_path, "abc", "merged")
    return tmp_path / "merged"


def only(run: Run) -> Finding:
    (finding,), _ = check(folder_of(run))
    return finding


def restored(finding: Finding, model: type[Any]) -> Any:
    assert isinstance(finding.cure, bytes)
    return decode_record(finding.key, finding.cure, model)


def test_sound_runs_have_no_findings_and_their_numbers_are_reported(
    sealed: Run, merged: Path, tmp_path: Path
) -> None:
    findings, checked = check(folder_of(sealed))
    assert (findings, checked.shards, checked.samples, checked.is_sealed) == ([], 2, 20, True)
    assert checked.bytes == sum(commit.object.size for commit in sealed.commits())
    totals = checked.totals
    assert (totals.attempts, totals.committed_wall_s, totals.wasted_wall_s) == (3, 2.0, 2.0)
    findings, checked = check(merged)
    assert (findings, checked.shards, checked.is_sealed) == ([], 5, True)
    make_run(tmp_path / "empty", 50, shards=[])
    assert found(tmp_path / "empty") == []


# Root records --------------------------------------------------------------------------------


def test_signed_records_that_differ_from_their_copies_or_in_form_are_found(sealed: Run) -> None:
    folder = folder_of(sealed)
    edit(folder / "manifest.json", code_version="9")
    edit(folder / "plans/1.json", created="now")
    record = json.loads((folder / "ledger/x-1.json").read_text())
    del record["sha256"]
    (folder / "ledger/x-1.json").write_bytes(signed_json(dict(reversed(record.items()))))
    told = [("manifest.json", None), ("plans/1.json", None), ("ledger/x-1.json", SetAside())]
    assert [(f.key, f.cure) for f in check(folder)[0]] == told


def test_plans_that_are_gone_or_shrink(tmp_path: Path) -> None:
    run = make_run(tmp_path, 10)
    run.grow(20)
    run.grow(30)
    both = ("plans/2.json", "copies/plans/2.json")
    run.storage.delete(both)
    assert found(tmp_path) == [("record", "plans/2.json")]
    first = (tmp_path / "plans/1.json").read_bytes()
    shrunk = encode_record(Plan(n=10, created="", spec_hash=run.manifest.spec_hash, number=2))
    for data, keys in ((first, both), (shrunk, both[:1])):
        for key in both:
            run.storage.put(key, data)
        assert found(tmp_path) == [("record", key) for key in keys]


def test_missing_parts_and_runs_and_other_formats_are_found_or_refused(merged: Path, sealed: Run) -> None:
    part = min((merged / "parts").iterdir())
    shutil.rmtree(part)
    assert ("record", f"parts/{part.name}/manifest.json") in found(merged) and not part.exists()
    for key in ("manifest.json", "copies/manifest.json"):
        edit(folder_of(sealed) / key, format_version=99)
    for place, problem in ((merged.parent, "not a run"), (folder_of(sealed), "99")):
        with pytest.raises(InputError, match=problem):
            check(place)


def test_a_torn_state_of_a_job_is_no_finding_and_a_damaged_job_is(sealed: Run) -> None:
    jobs, job = Jobs(sealed.storage), new_job_id()
    jobs.begin(JobRecord(id=job, command=(), host="h", pid=1, started=utc_now(), address="local"))
    jobs.put_state(JobState(id=job, updated=utc_now(), phase="making"))
    jobs.ask_to_stop(job, at_once=True)
    state = folder_of(sealed) / f"jobs/{job}.state.json"
    for data in (state.read_bytes()[:-1], b"", b"\0" * 100):
        state.write_bytes(data)
        assert found(folder_of(sealed)) == []
    (folder_of(sealed) / f"jobs/{job}.json").write_bytes(b"{}")
    assert found(folder_of(sealed)) == [("record", f"jobs/{job}.json")]


# Commits, objects and stores -----------------------------------------------------------------


def test_files_that_no_record_names_are_foreign_or_of_the_store(sealed: Run) -> None:
    folder = folder_of(sealed)
    sealed.storage.put("shards/superseded.zip", b"of an attempt that did not commit")
    sealed.storage.put("ledger/a-2.json.part", b"left by a killed writer")
    assert found(folder) == []
    for kind, keys in {
        "foreign": ("shards/notes.txt", "shards/000001/a-1/c.0", "ledger/notes.txt", "ledger/old/a-2.json"),
        "sealed": ("data.zarr/label/c.9", "data.zarr/other/c.0", "data.zarr/README"),
    }.items():
        for key in keys:
            sealed.storage.put(key, b"")
            assert found(folder) == [(kind, key)]
            sealed.storage.delete([key])


def test_a_store_that_is_outdated_is_no_damage(sealed: Run) -> None:
    sealed.grow(40)
    assert (only(sealed).kind, only(sealed).key) == ("stale", "data.zarr")
    attempt(sealed, 2, "a-2")
    assert found(folder_of(sealed)) == [("stale", "data.zarr")]


def test_a_record_of_a_store_that_states_other_things_is_found(sealed: Run) -> None:
    path = folder_of(sealed) / "data.json"
    whole = json.loads(path.read_text())
    del whole["sha256"]
    part = whole["parts"][0]
    for changes, kind in (
        ({"rows_sha256": "0" * 64}, "stale"),
        ({"parts": [part | {"n": 18}]}, "stale"),
        ({"parts": [part | {"missing": [[0, 1]]}]}, "stale"),
        ({"parts": [part | {"n": 10**12}]}, "lost"),  # shards that were never made
        ({"files": whole["files"][:-1]}, "sealed"),
    ):
        edit(path, **(whole | changes))
        assert [found_kind for found_kind, _ in found(folder_of(sealed))] == [kind]


# Rows ----------------------------------------------------------------------------------------


CHANGES: tuple[tuple[str, Any, float], ...] = (
    ("scene_index", slice(None), 9), ("sample_id", (3, 5), 7), ("candidate_index", 1, 0),
    ("sample_scene_index", -1, 2), ("label", 0, 2), ("label", slice(None), 1), ("redraws", (0, 0), 9999),
    ("distance_m", 0, -1.0), ("distance_m", 0, np.nan), ("points_m", (0, 0, 0), np.inf),
)  # fmt: skip


@pytest.mark.parametrize(("name", "at", "value"), CHANGES)
def test_rows_of_another_place_or_out_of_range_are_found(
    tmp_path: Path, name: str, at: Any, value: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every digest is right: a writer without our checks made and committed them."""
    run = make_run(tmp_path / "run", 20, shards=[0])
    scenes, samples = rows_of(run, 1)
    (scenes | samples)[name][at] = value
    with monkeypatch.context() as patch:
        patch.setattr(RecordSchema, "check", lambda *a: None)
        commit_object(run, 1, encoded(run, (scenes, samples)))
    assert found(folder_of(run)) == [("rows", f"shards/f.zip/{name}")]


def test_sums_in_a_commit_that_its_rows_do_not_have_and_arrays_of_other_types(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", 20)
    positives = run.commit_of(1).positives + 1
    edit(folder_of(run) / commit_key(1), positives=positives, redraws={"fell_off": 3})
    assert found(folder_of(run)) == [("rows", "shards/a-1.zip/label"), ("rows", "shards/a-1.zip/redraws")]
    run = make_run(tmp_path / "other", 20, shards=[0])
    fields = {f.name: f for f in run.schema.sample_fields}
    fields["distance_m"] = replace(fields["distance_m"], dtype="float64")
    scenes, samples = rows_of(run, 1)
    samples["distance_m"] = samples["distance_m"].astype("float64")
    other = replace(run.schema, sample_fields=tuple(fields.values()))
    commit_object(run, 1, encode_shard(other, run.layout, run.manifest.spec_hash, scenes, samples))
    prefix = "shards/f.zip/distance_m"
    assert found(folder_of(run)) == [("rows", f"{prefix}/zarr.json"), ("rows", prefix)]


# Ledger and quarantine -----------------------------------------------------------------------


def test_starts_follow_from_commits_or_ends_and_other_records_are_set_aside(sealed: Run) -> None:
    folder, key = folder_of(sealed), "ledger/a-0.start.json"
    known = AttemptStart(attempt="a-0", shard=0, started="")
    for changes in ({"shard": 1}, {"attempt": "x"}):
        edit(folder / key, **changes)
        assert (only(sealed).kind, only(sealed).key, only(sealed).shard) == ("account", key, 0)
        assert restored(only(sealed), AttemptStart) == known
        sealed.storage.put(key, encode_record(known))
    sealed.storage.delete(["ledger/x-1.start.json"])
    assert restored(only(sealed), AttemptStart) == AttemptStart(attempt="x-1", shard=1, started="")
    sealed.storage.put("ledger/x-1.json", b"{}")
    assert (only(sealed).key, only(sealed).cure) == ("ledger/x-1.json", SetAside())
    sealed.storage.delete(["ledger/x-1.json"])
    sealed.ledger.end(LedgerEntry(attempt="a-0", shard=0, outcome="failed"))  # of an attempt with a commit
    assert (only(sealed).key, only(sealed).cure) == ("ledger/a-0.json", SetAside())
    for ending in ("json", "start.json"):  # never overwritten
        (folder / f"ledger/a-0.{ending}").rename(folder / f"ledger/z.{ending}")
    told = [(f.key, f.problem, f.cure) for f in check(folder)[0]]
    assert ("ledger/z.json", "is the record of another", None) in told


def test_waste_adds_up_and_attempts_are_lost_once_their_shards_are_decided(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", shards=[1])
    for name in ("x", "y"):
        run.ledger.end(LedgerEntry(attempt=name, shard=0, outcome="failed", cost=COST))
    run.ledger.end(LedgerEntry(attempt="z", shard=0, outcome="lost"))
    run.ledger.start("open", 0)
    findings, checked = check(folder_of(run))
    totals = checked.totals
    assert (findings, totals.attempts, totals.without_account, totals.unfinished) == ([], 5, 1, 1)
    assert (totals.committed_wall_s, totals.wasted_wall_s) == (1.0, 6.0)
    run.quarantine(QUARANTINED)
    for name, shard in (("late", 1), ("hopeless", 3)):
        run.ledger.start(name, shard)
    findings, _ = check(folder_of(run))
    assert [(f.key, f.shard) for f in findings] == [("ledger/hopeless.json", 3), ("ledger/late.json", 1)]
    starts = {start.attempt: start for start in run.ledger.unfinished({"a-1"})}
    for entry in (restored(finding, LedgerEntry) for finding in findings):
        assert entry == lost_end(starts[entry.attempt], entry.ended)

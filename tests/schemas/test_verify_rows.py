"""What checks find in the files and rows of a shard whose digests may all be right."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.schemas.fields import RecordSchema
from datagen.schemas.outcomes import REDRAW_CAUSES
from datagen.schemas.record_files import commit_copy_key, commit_key
from datagen.schemas.run import Run
from datagen.schemas.run_records import LedgerEntry
from datagen.schemas.shard_files import encode_shard
from tests.made_runs import commit_of, make_run, rows_of
from tests.schemas.checked import check, edit, folder_of, found, sealed_run


def commit_forged(run: Run, shard: int, change: Callable[[dict[str, Any], dict[str, Any]], None]) -> None:
    """Commit a shard whose rows were changed before they were encoded: every digest is right."""
    scenes, samples = rows_of(run, shard)
    positives = int(samples["label"].sum())
    change(scenes, samples)
    files = encode_shard(run.schema, run.layout, run.manifest.spec_hash, scenes, samples)
    run.ledger.start(f"f-{shard}", shard)
    entries = run.write_shard(shard, f"f-{shard}", files)
    commit = commit_of(run, shard, f"f-{shard}", entries, positives, _sums(scenes))
    assert run.commit(commit)
    entry = LedgerEntry(attempt=commit.attempt, shard=shard, outcome="committed", cost=commit.cost)
    run.ledger.end(entry)


def _sums(scenes: dict[str, Any]) -> dict[str, int]:
    sums = zip(REDRAW_CAUSES, scenes["redraws"].sum(axis=0).tolist(), strict=True)
    return {cause: count for cause, count in sums if count}


@pytest.fixture
def sealed(tmp_path: Path) -> Run:
    return sealed_run(tmp_path / "run")


def test_a_file_that_no_record_knows_is_found(sealed: Run):
    (folder_of(sealed) / "shards/000000/a-0/label/c.9").write_bytes(b"x")
    (folder_of(sealed) / "shards/000000/other").mkdir()  # left by an attempt that did not commit
    (folder_of(sealed) / "shards/000000/other/x").write_bytes(b"x")
    assert found(folder_of(sealed)) == [("foreign", "shards/000000/a-0/label/c.9")]


def _out_of_place(scenes: dict[str, Any], samples: dict[str, Any]) -> None:
    scenes["scene_index"] += 1


def _other_id(scenes: dict[str, Any], samples: dict[str, Any]) -> None:
    samples["sample_id"][3, 5] ^= 1


def _twice(scenes: dict[str, Any], samples: dict[str, Any]) -> None:
    samples["candidate_index"][1] = samples["candidate_index"][0]


def _of_other_scene(scenes: dict[str, Any], samples: dict[str, Any]) -> None:
    samples["sample_scene_index"][-1] -= 1


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (_out_of_place, "scene_index"),
        (_other_id, "sample_id"),
        (_twice, "candidate_index"),
        (_of_other_scene, "sample_scene_index"),
    ],
)
def test_rows_that_are_not_those_of_their_place(
    tmp_path: Path, change: Callable[[dict[str, Any], dict[str, Any]], None], name: str
):
    run = make_run(tmp_path / "run", 20, shards=[0])
    commit_forged(run, 1, change)
    assert found(folder_of(run)) == [("rows", f"shards/000001/f-1/{name}")]


def test_sums_in_a_commit_that_its_rows_do_not_have(tmp_path: Path):
    run = make_run(tmp_path / "run", 20)
    folder = folder_of(run)
    positives = run.commit_of(1).positives + 1
    for key in (commit_key(1), commit_copy_key(1, "a-1")):
        edit(folder / key, positives=positives, redraws={"fell_off": 3})
    prefix = "shards/000001/a-1"
    assert found(folder) == [("rows", f"{prefix}/label"), ("rows", f"{prefix}/redraws")]


@pytest.mark.parametrize(
    ("name", "value"),
    [("visibility", 1.5), ("visibility", np.nan), ("label", 2), ("distance_m", -1.0), ("points_m", np.inf)],
)
def test_values_out_of_range_are_found_though_every_digest_is_right(
    tmp_path: Path, name: str, value: float, monkeypatch: pytest.MonkeyPatch
):
    run = make_run(tmp_path / "run", 20, shards=[0])

    def spoil(scenes: dict[str, Any], samples: dict[str, Any]) -> None:
        (scenes if name in scenes else samples)[name].flat[0] = value

    with monkeypatch.context() as m:  # a writer without the checks of ours
        m.setattr(RecordSchema, "check", lambda *a: None)
        commit_forged(run, 1, spoil)
    findings, _ = check(folder_of(run))
    assert ("rows", f"shards/000001/f-1/{name}") in [(f.kind, f.key) for f in findings]


def test_an_array_of_another_type_is_found(tmp_path: Path):
    run = make_run(tmp_path / "run", 20, shards=[0])
    fields = tuple(
        replace(f, dtype="float64") if f.name == "visibility" else f for f in run.schema.sample_fields
    )
    other = RecordSchema(
        run.schema.name, run.schema.version, run.schema.scene_fields, fields, run.schema.sizes
    )
    scenes, samples = rows_of(run, 1)
    samples["visibility"] = samples["visibility"].astype("float64")
    files = encode_shard(other, run.layout, run.manifest.spec_hash, scenes, samples)
    positives = int(samples["label"].sum())
    entries = run.write_shard(1, "f-1", files)
    commit = commit_of(run, 1, "f-1", entries, positives, _sums(scenes))
    run.ledger.start("f-1", 1)
    run.commit(commit)
    run.ledger.end(LedgerEntry(attempt="f-1", shard=1, outcome="committed", cost=commit.cost))
    prefix = "shards/000001/f-1/visibility"
    assert found(folder_of(run)) == [("rows", f"{prefix}/zarr.json"), ("rows", prefix)]


def test_a_commit_that_lacks_a_file_is_found(sealed: Run):
    folder = folder_of(sealed)
    record = json.loads((folder / commit_key(1)).read_text())
    files = [f for f in record["files"] if f["path"] != "label/c.0"]
    for key in (commit_key(1), commit_copy_key(1, "a-1")):
        edit(folder / key, files=files)
    kinds = found(folder)
    assert ("rows", commit_key(1)) in kinds and ("foreign", "shards/000001/a-1/label/c.0") in kinds

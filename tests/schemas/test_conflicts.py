"""Two runs that hold the same scenes: what counts as other rows, and how the first of them is named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.schemas.errors import InputError
from datagen.schemas.fields import SCHEMAS
from datagen.schemas.merging.conflicts import refuse_different_rows
from datagen.schemas.run import Run
from datagen.schemas.shard_files import encode_shard
from tests.faults.crash_points_operations import small_schema
from tests.made_runs import commit_of, make_run, rows_of

FIELDS = (
    "scene_index",
    "house_id",
    "redraws",
    "sample_id",
    "sample_scene_index",
    "candidate_index",
    "label",
    "distance_m",
)
Tables = tuple[dict[str, Any], dict[str, Any]]


@pytest.fixture(autouse=True)
def few_arrays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SCHEMAS, "heuristic", small_schema(FIELDS))


def made(folder: Path, shard: int, change: Callable[[Tables], None] | None = None, size: int = 2) -> Run:
    """A run that holds one shard of `size` scenes of five samples, its rows changed before writing."""
    run = make_run(folder, 40, size, shards=[])
    tables = rows_of(run, shard)
    if change is not None:
        change(tables)
    files = encode_shard(run.schema, run.layout, run.manifest.spec_hash, *tables)
    name = folder.name
    assert run.commit(commit_of(run, shard, name, run.write_shard(shard, name, files)))
    return run


def refusal(one: Run, shard_one: int, other: Run, shard_other: int) -> str:
    with pytest.raises(InputError) as refused:
        refuse_different_rows(one, shard_one, other, shard_other)
    return str(refused.value)


def sample(run: Run, shard: int, row: int) -> str:
    return rows_of(run, shard)[1]["sample_id"][row].tobytes().hex()


def test_equal_rows_are_no_conflict_text_included(tmp_path: Path) -> None:
    refuse_different_rows(made(tmp_path / "a", 0), 0, made(tmp_path / "b", 0), 0)


def test_the_first_sample_that_differs_is_named_and_the_first_file(tmp_path: Path) -> None:
    def change(tables: Tables) -> None:
        tables[1]["label"][6] ^= 1
        tables[1]["label"][9] ^= 1
        tables[1]["distance_m"][8] += 1

    one, other = made(tmp_path / "a", 0), made(tmp_path / "b", 0, change)
    told = refusal(one, 0, other, 0)
    assert told.startswith(f"{one.storage.url}: shard 0: {other.storage.url} has other rows: ")
    file = "shards/000000/a/distance_m/c.0"
    assert f"{file} differs, first in sample {sample(one, 0, 6)}, in label" in told


def test_of_fields_that_differ_in_one_sample_the_schemas_first_is_named(tmp_path: Path) -> None:
    def change(tables: Tables) -> None:
        tables[1]["label"][2] ^= 1
        tables[1]["distance_m"][2] += 1

    one = made(tmp_path / "a", 0)
    first = next(f.name for f in one.schema.sample_fields if f.name in ("label", "distance_m"))
    assert f"in sample {sample(one, 0, 2)}, in {first}" in refusal(one, 0, made(tmp_path / "b", 0, change), 0)


@pytest.mark.parametrize(("field", "value"), [("house_id", "another"), ("redraws", 7)])
def test_records_of_scenes_count_too(tmp_path: Path, field: str, value: Any) -> None:
    def change(tables: Tables) -> None:
        tables[0][field][1] = value

    one = made(tmp_path / "a", 0)
    told = refusal(one, 0, made(tmp_path / "b", 0, change), 0)
    assert f"{field}/" in told and f"first in sample {sample(one, 0, 5)}, in {field}" in told


def test_rows_are_compared_bit_for_bit(tmp_path: Path) -> None:
    def zero(sign: float) -> Callable[[Tables], None]:
        def change(tables: Tables) -> None:
            tables[1]["distance_m"][3] = np.copysign(0.0, sign)

        return change

    one, other = made(tmp_path / "a", 0, zero(1.0)), made(tmp_path / "b", 0, zero(-1.0))
    assert "in distance_m" in refusal(one, 0, other, 0)


def test_only_scenes_that_both_hold_are_compared(tmp_path: Path) -> None:
    def change(scene: int) -> Callable[[Tables], None]:
        def changed(tables: Tables) -> None:
            tables[1]["label"][5 * scene] ^= 1

        return changed

    small = made(tmp_path / "small", 1)  # scenes 2 and 3
    apart, other = made(tmp_path / "apart", 0, change(1), 4), made(tmp_path / "other", 0, change(3), 4)
    refuse_different_rows(small, 1, apart, 0)
    refuse_different_rows(apart, 0, small, 1)
    refuse_different_rows(made(tmp_path / "low", 0), 0, other, 0)
    words = f"label differs, first in sample {sample(small, 1, 5)}, in label"
    told = refusal(small, 1, other, 0)
    assert "small: shard 1: " in told and f"shards/000001/small/{words}" in told
    told = refusal(other, 0, small, 1)
    assert "other: shard 0: " in told and f"shards/000000/other/{words}" in told

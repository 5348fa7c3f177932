"""Stores of an older schema version under a program that writes a newer one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen import cli
from datagen.regeneration.deep_check import deep_findings
from datagen.regeneration.scenes import open_sources
from datagen.schemas.fields import OLDEST_SCHEMA_VERSION, SCHEMA_VERSION, SCHEMAS, Field, sized_schema
from datagen.schemas.run import Run
from datagen.schemas.scene_rows import read_scene
from datagen.train.reader import SampleReader
from datagen.workers import run_shard
from datagen.workers.labels import heuristic_source
from tests.made_runs import small_spec
from tests.refusals import refused
from tests.small_runs import PER_SCENE, arrays_of, assert_equal_runs, json_of, make_small_run

N = 2 * PER_SCENE
NEWER = SCHEMA_VERSION + 1
PER_SCENE_FIELD = Field("n_bodies", "int32", (), "1", "", "bodies of the house", 0, since=NEWER)
PER_SAMPLE_FIELD = Field("bearing_rad", "float32", (), "rad", "world", "heading of the base", since=NEWER)
NEW = {"n_bodies", "bearing_rad"}


@pytest.fixture(scope="module")
def older(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of the present version. Tests only read it."""
    return make_small_run(tmp_path_factory.mktemp("older") / "run", N)


def learn_fields(patch: pytest.MonkeyPatch) -> None:
    """Let the program write a version with one more field in each table, as its next release might."""
    before = SCHEMAS["heuristic"]
    scene, sample = (*before.scene_fields, PER_SCENE_FIELD), (*before.sample_fields, PER_SAMPLE_FIELD)
    patch.setitem(
        SCHEMAS, "heuristic", replace(before, version=NEWER, scene_fields=scene, sample_fields=sample)
    )
    record, source = run_shard.scene_row, heuristic_source.HEURISTIC

    def scene_row(scene: Any) -> dict[str, Any]:
        return {**record(scene), "n_bodies": len(scene.house.house.bodies)}

    def label(scene: Any, candidates: Any, spec: Any, clock: Any) -> dict[str, Any]:
        apart = candidates.base_xy_m - scene.target_center_m[:2]
        bearing = np.arctan2(apart[:, 1], apart[:, 0]).astype(np.float32)
        return {**source.label(scene, candidates, spec, clock), "bearing_rad": bearing}

    patch.setattr(run_shard, "scene_row", scene_row)
    patch.setattr("datagen.regeneration.scenes.scene_row", scene_row)
    patch.setattr(heuristic_source, "HEURISTIC", replace(source, label=label))


def test_a_newer_program_writes_its_fields_and_an_older_one_refuses_that_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        learn_fields(patch)
        run = make_small_run(tmp_path / "run", N)
        arrays = arrays_of(run)
        assert set(arrays) >= NEW and np.ptp(arrays["bearing_rad"]) > 0 and arrays["n_bodies"].min() > 0
        assert Run.open(run).manifest.schema_version == NEWER
        opened = Run.open(run)
        assert list(deep_findings(opened, 3, open_sources(opened), np.random.default_rng(0))) == []
    words = ("schema_version", f"is {NEWER}, but this program reads", f"to {SCHEMA_VERSION}. Use the version")
    refused(["show", str(run), "--out", str(tmp_path / "scene.png")], capsys, *words)
    again = ["submit", "heuristic", "--n", str(2 * N), "--out", str(run), "--workers", "0"]
    refused([*again, "--config", str(tmp_path / "run.toml"), "--candidates-per-scene", "8"], capsys, *words)


def test_an_older_run_goes_on_without_the_new_fields(
    older: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    begun = make_small_run(tmp_path / "run", N)
    (begun / "commits/000001.json").unlink()
    whole = make_small_run(tmp_path / "whole", N)
    make_small_run(whole, 2 * N)
    with pytest.MonkeyPatch.context() as patch:
        learn_fields(patch)
        make_small_run(begun, 2 * N)  # resumes, extends and seals
        assert_equal_runs(arrays_of(begun), arrays_of(whole))
        run = Run.open(begun)
        assert run.manifest.schema_version == SCHEMA_VERSION == run.schema.version
        assert list(deep_findings(run, 4, open_sources(run), np.random.default_rng(0))) == []
        assert json_of(capsys, ["status", str(begun)])["labels"] == 2 * N
        assert json_of(capsys, ["audit", str(begun)])
        assert cli.run(["show", str(begun), "--out", str(tmp_path / "scene.png")]) == 0
    for shard in range(2, 4):
        for name, digest in metadata_digests(Run.open(begun), shard).items():
            assert digest == metadata_digests(run, 0)[name]


def metadata_digests(run: Run, shard: int) -> Mapping[str, str]:
    """sha256 of each zarr.json of a shard."""
    return {e.path: e.sha256 for e in run.commit_of(shard).files if e.path.endswith("zarr.json")}


def test_stores_of_both_versions_are_read_side_by_side(older: Path, tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        learn_fields(patch)
        newer = make_small_run(tmp_path / "run", N, "--seed", "1")
        reader = SampleReader([older, newer])
        assert len(reader) == 2 * N
        assert sum(len(shard["label"]) for shard in reader.shards()) == 2 * N
        assert "n_bodies" in read_scene(Run.open(newer), 0).record
        assert "n_bodies" not in read_scene(Run.open(older), 0).record


def test_scenes_of_an_older_run_are_labelled_in_its_version(older: Path, tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        learn_fields(patch)
        out = tmp_path / "again"
        more = ["--out", str(out), "--scenes-from", str(older), "--workers", "0"]
        assert cli.run(["submit", "heuristic", "--n", str(N), *more]) == 0
        assert Run.open(out).manifest.schema_version == SCHEMA_VERSION
        assert not NEW & set(arrays_of(out))
        np.testing.assert_array_equal(arrays_of(out)["label"], arrays_of(older)["label"])


@pytest.mark.parametrize("name", sorted(SCHEMAS))
def test_fields_came_with_a_version_that_the_schema_has_reached(name: str) -> None:
    schema = SCHEMAS[name]
    for field in (*schema.scene_fields, *schema.sample_fields):
        assert OLDEST_SCHEMA_VERSION <= field.since <= schema.version == SCHEMA_VERSION
    assert sized_schema(name, small_spec(), SCHEMA_VERSION) == sized_schema(name, small_spec())


def test_an_older_schema_is_the_newer_one_without_what_came_since() -> None:
    before = sized_schema("heuristic", small_spec())
    with pytest.MonkeyPatch.context() as patch:
        learn_fields(patch)
        after = sized_schema("heuristic", small_spec(), SCHEMA_VERSION)
        assert after.later == NEW
        assert replace(after, later=frozenset()) == before
        assert sized_schema("heuristic", small_spec()).version == NEWER

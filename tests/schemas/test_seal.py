"""The sealed store: what stock libraries read is what was committed."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import threading
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray
import zarr

from datagen.schemas import shard_files
from datagen.schemas.checking.check_runs import Checked, check_runs
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.sealing import SEALED, seal
from datagen.schemas.specification import Source
from tests.made_runs import check_digests, files_of, make_run, rows_of, small_spec, write


def clear_metadata() -> None:
    shard_files.group_metadata.cache_clear()
    shard_files._made_by_zarr.cache_clear()


def expected(run: Run, shards: list[int], scenes: int, samples: int) -> dict[str, np.ndarray]:
    tables = [rows_of(run, shard) for shard in shards]
    out: dict[str, np.ndarray] = {}
    for t, rows in ((0, scenes), (1, samples)):
        out |= {k: np.concatenate([each[t][k] for each in tables])[:rows] for k in tables[0][t]}
    return out


def assert_equal(group: zarr.Group, arrays: dict[str, np.ndarray]) -> None:
    assert set(group.array_keys()) == set(arrays)
    for name, values in arrays.items():
        np.testing.assert_array_equal(group[name][:], values, err_msg=name)


def test_stock_zarr_reads_every_row_in_order(tmp_path: Path):
    run = make_run(tmp_path, n=43, shards=[4, 0, 2, 1, 3])
    path = seal(run.storage)
    assert path == str(tmp_path / SEALED)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        group = zarr.open(path, mode="r")
        assert_equal(group, expected(run, [0, 1, 2, 3, 4], 9, 43))
    assert group.attrs["spec_hash"] == run.manifest.spec_hash
    assert group.attrs["specification"] == run.manifest.spec.model_dump(mode="json")
    assert (group.attrs["n"], group.attrs["missing_shards"]) == (43, [])


def test_stock_xarray_reads_dimensions_units_and_values_without_a_warning(tmp_path: Path):
    run = make_run(tmp_path, n=43)
    path = seal(run.storage)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        data = xarray.open_zarr(path, chunks=None)
        loaded = data.load()
    assert (data.sizes["scene"], data.sizes["sample"]) == (9, 43)
    for name, values in expected(run, [0, 1, 2, 3, 4], 9, 43).items():
        np.testing.assert_array_equal(loaded[name].values, values, err_msg=name)
    for table, fields in (("scene", run.schema.scene_fields), ("sample", run.schema.sample_fields)):
        for f in fields:
            assert data[f.name].dims == (table, *f.dims)
            assert data[f.name].attrs.get("units", "") == f.unit
            assert data[f.name].attrs["long_name"] == f.doc


def test_missing_shards_are_packed_and_named(tmp_path: Path):
    run = make_run(tmp_path, n=48, shards=[1, 4])
    group = zarr.open(seal(run.storage), mode="r")
    assert_equal(group, expected(run, [1, 4], 4, 18))
    assert group.attrs["missing_shards"] == [0, 2, 3]


def test_sealing_again_after_growth_replaces_the_store(tmp_path: Path):
    run = make_run(tmp_path, n=13)
    seal(run.storage)
    grown = make_run(tmp_path, n=37)
    assert_equal(zarr.open(seal(grown.storage), mode="r"), expected(grown, [0, 1, 2, 3], 8, 37))
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(SEALED)] == [SEALED]


def test_chunks_are_links_that_cannot_be_written(tmp_path: Path):
    run = make_run(tmp_path, n=20)
    path = seal(run.storage)
    linked, own = Path(path) / "label" / "c.1", tmp_path / "shards/000001/a-1/label/c.0"
    assert linked.samefile(own)
    assert own.stat().st_mode & 0o777 == 0o444


def test_nothing_committed_and_damaged_shards_are_refused_and_leave_the_old_store(tmp_path: Path):
    with pytest.raises(InputError, match="no shard is committed"):
        seal(make_run(tmp_path / "empty", shards=[]).storage)
    run = make_run(tmp_path / "run", n=20)
    before = files_of(Path(seal(run.storage)))
    (tmp_path / "run/shards/000001/a-1/rgb/c.0.0.0").unlink()
    with pytest.raises(InputError, match=r"rgb/c\.0\.0\.0: is missing"):
        seal(run.storage)
    assert files_of(tmp_path / "run" / SEALED) == before


def test_runs_of_more_shards_than_a_store_can_name_are_refused(tmp_path: Path):
    run = make_run(tmp_path, n=20, shards=[0])
    seal(run.storage)
    run.grow(10**12)
    with pytest.raises(InputError, match="99999999999 planned shards are missing"):
        seal(run.storage)
    root = tmp_path / SEALED / "zarr.json"
    told = json.loads(root.read_bytes())
    told["attributes"] |= {"n": 10**12, "missing_shards": []}
    root.chmod(0o644)
    root.write_text(json.dumps(told))
    findings = list(check_runs(run.storage, Checked()))
    assert [(f.key, f.kind) for f in findings] == [(f"{SEALED}/zarr.json", "sealed")]
    assert "names 100000000000 shards" in findings[0].problem


def test_a_commit_that_lists_other_files_is_refused(tmp_path: Path):
    run = make_run(tmp_path, n=20, shards=[0])
    commit = write(run, 1, "b")
    assert run.commit(commit.model_copy(update={"files": commit.files[:-1]}))
    with pytest.raises(InputError, match="1 files are missing or extra"):
        seal(run.storage)


def test_what_a_killed_seal_leaves_does_not_disturb(tmp_path: Path):
    run = make_run(tmp_path, n=20)
    (tmp_path / f"{SEALED}.0123.partial" / "label").mkdir(parents=True)
    assert_equal(zarr.open(seal(run.storage), mode="r"), expected(run, [0, 1], 4, 20))
    assert Run.open(tmp_path).committed() == {0, 1}


def test_large_clouds_in_several_chunks_a_shard(tmp_path: Path):
    run = make_run(tmp_path, n=1, scenes_per_shard=6, shards=[])
    patch = pytest.MonkeyPatch()
    with patch.context() as m:
        m.setattr(shard_files, "MAX_CHUNK_BYTES", 1000)  # real clouds would take gigabytes
        clear_metadata()
        run.grow(75)
        for shard in run.missing():
            assert run.commit(write(run, shard, "a"))
        group = zarr.open(seal(run.storage), mode="r")
        assert_equal(group, expected(run, [0, 1, 2], 15, 75))
        assert group["points_m"].chunks[0] == 2
    clear_metadata()


def test_labels_of_random_clouds_fit_the_budget(tmp_path: Path):
    """180,000 labels in 400 MB is 2,222 bytes each; random clouds are the worst case."""
    spec = small_spec(n_points=4096)
    make_run(tmp_path, n=600, scenes_per_shard=10, candidates_per_scene=60, spec=spec)
    total = sum(p.stat().st_size for p in (tmp_path / "shards").rglob("*") if p.is_file())
    assert total / 600 < 400e6 / 180_000


def test_a_disk_that_fills_up_keeps_what_is_committed_and_goes_on_with_room(tiny_disk: Path):
    run = make_run(tiny_disk, n=1, shards=[])
    run.grow(300)
    with pytest.raises(InputError, match=r"No space left on device\. Free disk space") as e:
        for shard in run.missing():
            assert run.commit(write(run, shard, "a"))
    assert "\n" not in str(e.value)
    done = sorted(run.committed())
    for commit in Run.open(tiny_disk).commits():
        check_digests(run, commit)
    with pytest.raises(InputError, match="No space left on device"):
        seal(run.storage)
    assert [p.name for p in tiny_disk.iterdir() if p.name.startswith(SEALED)] == []
    subprocess.run(["mount", "-o", "remount,size=64m", str(tiny_disk)], check=True)
    for shard in run.missing()[:2]:
        assert run.commit(write(run, shard, "b"))
    group = zarr.open(seal(run.storage), mode="r")
    shards = [*done, len(done), len(done) + 1]
    assert_equal(group, expected(run, shards, 2 * len(shards), 10 * len(shards)))


def test_two_jobs_that_seal_at_the_same_time_leave_one_whole_store(tmp_path: Path):
    """As when two drivers of one run see its last commit together."""
    run = make_run(tmp_path, n=20)
    seal(run.storage)
    renames: list[Path] = []
    plain = Path.rename

    def rename(path: Path, target: Path) -> Path:
        if target == tmp_path / SEALED and not renames:
            renames.append(path)
            seal(Run.open(tmp_path).storage)  # the other one, between this one's two steps
        return plain(path, target)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "rename", rename)
        seal(run.storage)
    assert renames
    assert_equal(zarr.open_group(tmp_path / SEALED, mode="r"), expected(run, [0, 1], 4, 20))
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(SEALED)] == [SEALED]


def test_readers_find_a_whole_store_while_it_is_sealed_again_and_again(tmp_path: Path):
    """One exchange of names: there is no moment without a store."""
    run = make_run(tmp_path, n=20)
    seal(run.storage)
    done, failures, opened = threading.Event(), list[BaseException](), 0

    def reader() -> None:
        nonlocal opened
        while not done.is_set():
            try:
                root = (tmp_path / SEALED / "zarr.json").read_bytes()
                assert b"consolidated_metadata" in root
                opened += 1
            except (OSError, AssertionError) as e:
                failures.append(e)
                return

    thread = threading.Thread(target=reader)
    thread.start()
    try:
        for _ in range(10):
            seal(run.storage)
    finally:
        done.set()
        thread.join()
    assert failures == [] and opened > 10


def test_where_names_cannot_be_exchanged_two_renames_do(tmp_path: Path):
    run = make_run(tmp_path, n=13)
    seal(run.storage)
    grown = make_run(tmp_path, n=37)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("datagen.schemas.sealing._exchange", lambda one, other: False)
        seal(grown.storage)
        assert_equal(zarr.open_group(tmp_path / SEALED, mode="r"), expected(grown, [0, 1, 2, 3], 8, 37))
        before = files_of(tmp_path)
        refuse_renames_onto(tmp_path / SEALED, patch)
        with pytest.raises(InputError, match="Input/output error"):
            seal(grown.storage)
    assert files_of(tmp_path) == before  # the old store got its name back


def refuse_renames_onto(target: Path, patch: pytest.MonkeyPatch) -> None:
    """Let the renaming of a finished store onto a free name fail."""
    plain, refused = Path.rename, list[Path]()

    def rename(path: Path, onto: Path) -> Path:
        if onto == target and not target.exists() and not refused:
            refused.append(path)
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))
        return plain(path, onto)

    patch.setattr(Path, "rename", rename)


@pytest.mark.parametrize("kind", ["file", "link", "empty folder"])
def test_whatever_has_the_name_makes_way(tmp_path: Path, kind: str):
    run = make_run(tmp_path / "run", n=20)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "kept").write_text("")
    sealed = tmp_path / "run" / SEALED
    if kind == "file":
        sealed.write_text("no store")
    elif kind == "link":
        sealed.symlink_to(elsewhere)
    else:
        sealed.mkdir()
    assert_equal(zarr.open_group(seal(run.storage), mode="r"), expected(run, [0, 1], 4, 20))
    assert [p.name for p in sealed.parent.iterdir() if p.name.startswith(SEALED)] == [SEALED]
    assert (elsewhere / "kept").exists()


def test_the_store_says_its_conventions_source_licences_and_coordinates(tmp_path: Path):
    spec = small_spec().model_copy(
        update={
            "houses": Source(kind="procthor", digest="1" * 64),
            "objects": Source(kind="ycb", digest="2" * 64),
        }
    )
    run = make_run(tmp_path / "a", n=13, spec=spec)
    told = xarray.open_zarr(seal(run.storage), chunks=None).attrs
    assert told["title"].endswith("in houses read as procthor with objects read as ycb")
    assert told["license"] == "houses read as procthor: not stated; objects read as ycb: not stated"
    assert told["references"] == ""
    stated = {"title": "My houses", "licence": "CC0-1.0", "attribution": "me"}
    sources = {f"houses_{key}": text for key, text in stated.items()} | {"objects_licence": "MIT"}
    run = make_run(tmp_path / "b", n=13, spec=spec, sources=sources)
    data = xarray.open_zarr(seal(run.storage), chunks=None)
    told = data.attrs
    assert told["Conventions"] == "CF-1.11, ACDD-1.3"
    assert told["title"] == "Robot base poses labelled by heuristic, in My houses with objects read as ycb"
    assert told["license"] == "My houses: CC0-1.0; objects read as ycb: MIT"
    assert told["references"] == "me" and told["acknowledgement"].startswith("My houses: me; ")
    assert f"objects ycb sha256 {'2' * 64}" in told["source"]
    assert (
        told["history"].startswith("datagen submit heuristic --n 13, seed 0")
        and spec.hash() in told["history"]
    )
    assert "datagen.candidates" in told["comment"]
    coordinates = {"scene_index", "house_id", "sample_scene_index", "candidate_index", "robot_index"}
    assert set(data.coords) == coordinates
    assert data["label"].encoding["coordinates"] == "sample_scene_index candidate_index robot_index"


def test_two_stores_of_one_specification_have_equal_metadata(tmp_path: Path):
    roots = [Path(seal(make_run(tmp_path / name, n=13).storage)) / "zarr.json" for name in "ab"]
    assert roots[0].read_bytes() == roots[1].read_bytes()

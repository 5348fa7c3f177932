"""One sealed store over several runs, and how it is taken away again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import zarr

from datagen.schemas.errors import InputError
from datagen.schemas.record_files import MERGED, encode_record, part_folder
from datagen.schemas.run import Run, open_runs
from datagen.schemas.run_records import Merged
from datagen.schemas.sealing import SEALED, seal, sealed_root, unseal
from datagen.schemas.storage import Storage, open_storage
from tests.made_runs import files_of, make_run, rows_of, small_spec


def make_merged(folder: Path, *wanted: tuple[int, list[int] | None], **choices: int) -> Storage:
    """A merged place whose parts, in the order of their hashes, have so many samples and these shards."""
    specs = sorted((small_spec(seed) for seed in range(len(wanted))), key=lambda spec: spec.hash())
    for spec, (n, shards) in zip(specs, wanted, strict=True):
        make_run(folder / part_folder(spec.hash()), n, shards=shards, spec=spec, **choices)
    place = open_storage(folder)
    assert place.put_new(MERGED, encode_record(Merged(parts=tuple(spec.hash() for spec in specs))))
    return place


def expected(shards: list[tuple[Run, int]], scenes: int, samples: int) -> dict[str, np.ndarray]:
    tables = [rows_of(run, shard) for run, shard in shards]
    out: dict[str, np.ndarray] = {}
    for t, rows in ((0, scenes), (1, samples)):
        out |= {k: np.concatenate([each[t][k] for each in tables])[:rows] for k in tables[0][t]}
    return out


def assert_equal(path: str, arrays: dict[str, np.ndarray]) -> None:
    group = zarr.open_group(path, mode="r")
    assert set(group.array_keys()) == set(arrays)
    for name, values in arrays.items():
        np.testing.assert_array_equal(group[name][:], values, err_msg=name)


def test_rows_of_the_parts_follow_each_other_and_only_the_end_is_cut(tmp_path: Path):
    place = make_merged(tmp_path, (23, None), (38, [0, 2, 3]), (12, None))
    one, two, three = runs = open_runs(place)
    path = seal(place)
    assert path == str(tmp_path / SEALED)
    shards = [(one, 0), (one, 1), (one, 2), (two, 0), (two, 2), (two, 3), (three, 0), (three, 1)]
    assert_equal(path, expected(shards, 15, 72))
    root = sealed_root(place)
    assert root is not None
    told = [(part.spec_hash, part.n, part.missing_shards) for part in root.parts]
    assert told == [
        (run.manifest.spec_hash, n, missing)
        for run, n, missing in zip(runs, (23, 38, 12), ([], [1], []), strict=True)
    ]
    parts = zarr.open_group(path, mode="r").attrs["parts"]
    assert [part["shards"] for part in parts] == [3, 3, 2]
    assert [part["specification"]["seed"] for part in parts] == [run.manifest.spec.seed for run in runs]


def test_a_part_without_a_commit_gives_no_row(tmp_path: Path):
    place = make_merged(tmp_path, (23, None), (38, []))
    one, _ = open_runs(place)
    assert_equal(seal(place), expected([(one, 0), (one, 1), (one, 2)], 5, 23))
    root = sealed_root(place)
    assert root is not None
    assert root.parts[1].missing_shards == [0, 1, 2, 3]


def test_parts_need_no_store_of_their_own_and_keep_their_files(tmp_path: Path):
    place = make_merged(tmp_path, (20, None), (20, None))
    before = files_of(tmp_path)
    seal(place)
    assert not list((tmp_path / "parts").rglob(SEALED))
    unseal(place)
    assert files_of(tmp_path) == before


def test_parts_of_other_arrays_are_refused(tmp_path: Path):
    specs = sorted((small_spec(0), small_spec(1, n_points=65)), key=lambda spec: spec.hash())
    for spec in specs:
        make_run(tmp_path / part_folder(spec.hash()), 20, spec=spec)
    place = open_storage(tmp_path)
    place.put_new(MERGED, encode_record(Merged(parts=tuple(spec.hash() for spec in specs))))
    with pytest.raises(InputError, match=r"manifest\.json: spec: .*one store cannot hold both"):
        seal(place)


def test_unsealing_leaves_the_run_and_can_be_repeated(tmp_path: Path):
    run = make_run(tmp_path, n=43)
    before = files_of(tmp_path)
    for _ in range(2):
        seal(run.storage)
        assert sealed_root(run.storage) is not None
        unseal(run.storage)
        unseal(run.storage)
        assert sealed_root(run.storage) is None
        assert files_of(tmp_path) == before

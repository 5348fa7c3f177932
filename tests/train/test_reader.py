"""The reader of columns: every row as it was committed, and nothing damaged passes."""

from __future__ import annotations

import shutil
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.reports.agreement import read_labels
from datagen.schemas import run as run_module
from datagen.schemas.errors import InputError
from datagen.schemas.sealing import seal
from datagen.schemas.shard_reading import read_scene
from datagen.train.dataset import SampleStream
from datagen.train.reader import read_shards
from datagen.train.run_parts import JOIN_FIELDS, RunPart, open_parts
from tests.columns import columns_of, opened
from tests.made_runs import make_run, rows_of
from tests.train.stream_runs import make_stream_run

SAMPLES = ("sample_id", "sample_scene_index", "candidate_index", "distance_m", "label", "label_source")
ALL = ("points_m", "rgb", "target_mask", "house_id", "object_name", *SAMPLES)


def samples_in(parts: list[RunPart]) -> int:
    return sum(shard.samples for part in parts for shard in part.shards)


def test_shards_are_the_committed_rows_with_their_scenes(tmp_path: Path):
    run = make_run(tmp_path, n=43)
    shards = columns_of(tmp_path, ALL)
    assert sum(len(s["scene_index"]) for s in shards) == 9
    assert [len(s["label"]) for s in shards] == [10, 10, 10, 10, 3]
    for k, s in enumerate(shards):
        scenes, samples = rows_of(run, k)
        for name in SAMPLES:
            np.testing.assert_array_equal(s[name], samples[name][: len(s[name])])
        np.testing.assert_array_equal(s["scene_index"][s["scene_row"]], s["sample_scene_index"])
        assert s["points_m"].dtype == np.float32
        clouds = scenes["points_m"][: len(s["points_m"])]
        np.testing.assert_array_equal(s["points_m"], clouds.astype(np.float32))


def test_a_copied_sealed_store_reads_like_its_run_which_may_be_named_like_one(tmp_path: Path):
    run = make_run(tmp_path / "run.zarr", n=48, shards=[0, 2, 4])
    shutil.copytree(seal(run.storage), tmp_path / "alone.zarr")
    assert samples_in(opened(tmp_path / "run.zarr", allow_incomplete=True)) == 28
    (tmp_path / "run.zarr/shards/a-2.zip").unlink()
    sealed = opened(tmp_path / "alone.zarr", ALL)
    batches = list(read_shards(sealed))
    assert [len(b["label"]) for b in batches] == [10, 10, 8]
    assert samples_in(sealed) == 28
    for b, shard in zip(batches, (0, 2, 4), strict=True):
        stored = rows_of(run, shard)[1]["distance_m"]
        np.testing.assert_array_equal(b["distance_m"], stored[: len(b["distance_m"])])


def test_every_bit_flip_of_an_object_is_detected_and_named(tmp_path: Path):
    make_run(tmp_path, n=20)
    rng = np.random.default_rng(3)
    victim = tmp_path / "shards/a-1.zip"
    whole = victim.read_bytes()
    parts = opened(tmp_path, ALL)
    list(read_shards(parts))  # from here on checksums inside the object guard the chunks
    rows = whole.index(b"distance_m/c.0") + 30  # within a chunk that is read
    for bit in [*rng.integers(0, 8 * len(whole), 60), 8 * rows]:
        data = bytearray(whole)
        data[bit // 8] ^= 1 << (bit % 8)
        victim.write_bytes(data)
        with pytest.raises(InputError, match=r"a-1\.zip: .*another sha256"):
            columns_of(tmp_path, ALL)
    with pytest.raises(InputError, match=r"a-1\.zip/distance_m/c\.0: "):
        list(read_shards(parts))
    victim.write_bytes(whole)
    assert len(list(read_shards(parts))) == 2


def test_missing_and_cut_objects_are_named(tmp_path: Path):
    make_run(tmp_path, n=20)
    victim = tmp_path / "shards/a-0.zip"
    parts = opened(tmp_path)
    victim.write_bytes(victim.read_bytes()[:-3])
    with pytest.raises(InputError, match=r"a-0\.zip: has \d+ bytes with another sha256"):
        next(read_shards(parts))
    victim.unlink()
    with pytest.raises(InputError, match=r"a-0\.zip: no such file"):
        next(read_shards(parts))


def test_unreadable_runs_are_refused(tmp_path: Path):
    make_run(tmp_path / "run", n=20)
    make_run(tmp_path / "bare", n=20, shards=[])
    (tmp_path / "odd.zarr").mkdir()
    cases = [
        ([], "label", "no run is given"),
        ([tmp_path / "bare"], "label", "no shard is committed"),
        ([tmp_path / "odd.zarr"], "label", "no such file"),
        ([tmp_path / "none"], "label", "no such folder"),
        ([tmp_path / "run"], "beauty", "beauty: is not a field of the run"),
    ]
    for places, name, problem in cases:
        with pytest.raises(InputError, match=problem):
            open_parts(places, (*JOIN_FIELDS, name), allow_incomplete=True)


def test_hostile_metadata_of_a_sealed_store_is_refused(tmp_path: Path):
    path = Path(seal(make_run(tmp_path, n=20).storage))
    meta, root = path / "distance_m" / "zarr.json", path / "zarr.json"
    text = meta.read_text()
    chunks = '"chunk_shape": [\n          10\n'
    changes = [
        *(('"float32"', f'"{dtype}"') for dtype in ("float64", "object", "complex64")),
        ('"little"', '"big"'),
        ('"zstd"', '"gzip"'),
        ('"crc32c"', '"crc32d"'),
        ('"sample"', '"samples"'),
        ('"shape": [\n    20\n', '"shape": [\n    1000000000000\n'),
        *((chunks, chunks.replace("10", size)) for size in ("1000000000", "0", "7")),
        ('"end"', '"start"'),
    ]
    for old, new in changes:
        assert old in text
        meta.write_text(text.replace(old, new))
        with pytest.raises(InputError):
            columns_of(path)
    broken = '{"attributes": {}}', '{"attributes": 3}', '{"attributes": null}', "[" * 100_000
    for text in ("", "{}", "[]", *broken):
        root.write_text(text)
        with pytest.raises(InputError, match="not the root of a sealed store"):
            opened(path)


@pytest.mark.parametrize("remote", [False, True])
def test_objects_that_were_swapped_are_refused_by_every_reader(
    tmp_path: Path, remote: bool, request: pytest.FixtureRequest
):
    """Each is whole by itself."""
    place = f"{request.getfixturevalue('bucket')}/run" if remote else str(tmp_path)
    run = make_run(place, n=20)
    keys = ("shards/a-0.zip", "shards/a-1.zip")
    for key, other in zip(keys, [run.storage.get(key, 2**20) or b"" for key in reversed(keys)], strict=True):
        run.storage.put(key, other)
    for read in (
        lambda: columns_of(place),
        lambda: read_labels(run),
        lambda: read_scene(run, 0),
        lambda: SampleStream([place]),
    ):
        with pytest.raises(InputError, match=r"another sha256 than the commit|more than the"):
            read()


def test_an_object_is_checked_against_its_commit_once_per_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    make_run(tmp_path, n=20)
    hashed: list[int] = []

    def counted(data: bytes) -> Any:
        hashed.append(len(data))
        return sha256(data)

    monkeypatch.setattr(run_module, "sha256", counted)
    parts = opened(tmp_path, ("points_m", "label"))
    first = list(read_shards(parts))
    assert len(hashed) == 2
    for again, before in zip(read_shards(parts), first, strict=True):
        np.testing.assert_array_equal(again["label"], before["label"])
    assert len(hashed) == 2


def test_an_incomplete_run_is_read_only_with_allow_incomplete(tmp_path: Path):
    make_run(tmp_path, n=30)
    (tmp_path / "commits/000001.json").unlink()
    words = r"10 of the 30 planned samples are missing\. .*resume.*allow an incomplete run"
    for read in (lambda: opened(tmp_path), lambda: SampleStream([tmp_path])):
        with pytest.raises(InputError, match=words) as error:
            read()
        assert error.value.place == str(tmp_path)
    assert samples_in(opened(tmp_path, allow_incomplete=True)) == 20
    assert SampleStream([tmp_path], allow_incomplete=True).n_samples == 20


def test_numbers_that_no_run_stores_are_refused(tmp_path: Path):
    for value in (np.nan, np.inf):
        make_stream_run(tmp_path / str(value), 36, distance_m=value)
        with pytest.raises(InputError, match="distance_m: holds NaN or infinite numbers"):
            columns_of(tmp_path / str(value), ["distance_m"])

"""The reader of columns: every row as it was committed, and nothing damaged passes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.reports.agreement import read_labels
from datagen.schemas import shard_reading
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.sealing import seal
from datagen.schemas.shard_files import encode_shard
from datagen.schemas.shard_reading import read_scene
from datagen.train.dataset import SampleStream
from datagen.train.reader import Columns, SampleReader
from tests.made_runs import commit_of, make_run, rows_of, small_spec
from tests.train.stream_runs import make_stream_run

ALL = ("scene_index", *("points_m", "rgb", "target_mask", "house_id", "object_name"))
SAMPLES = ("sample_id", "sample_scene_index", "candidate_index", "distance_m", "label", "label_source")


def ids(batches: list[Columns]) -> np.ndarray:
    return np.concatenate([b["sample_id"] for b in batches])


def stored_samples(run: Run) -> dict[str, np.ndarray]:
    tables = [rows_of(run, k) for k in sorted(run.committed())]
    return {k: np.concatenate([t[1][k] for t in tables])[: run.n] for k in tables[0][1]}


def test_shards_are_the_committed_rows_with_their_scenes(tmp_path: Path):
    run = make_run(tmp_path, n=43)
    reader = SampleReader([tmp_path], ALL, SAMPLES)
    assert (len(reader), reader.n_scenes) == (43, 9)
    shards = list(reader.shards())
    assert [len(s["label"]) for s in shards] == [10, 10, 10, 10, 3]
    truth = stored_samples(run)
    for name in SAMPLES:
        np.testing.assert_array_equal(np.concatenate([s[name] for s in shards]), truth[name])
    clouds = np.concatenate([rows_of(run, k)[0]["points_m"] for k in sorted(run.committed())])
    for s in shards:
        np.testing.assert_array_equal(s["scene_index"][s["scene_row"]], s["sample_scene_index"])
        assert s["points_m"].dtype == np.float32
        np.testing.assert_array_equal(s["points_m"], clouds[s["scene_index"]].astype(np.float32))


def test_a_copied_sealed_store_reads_like_its_run(tmp_path: Path):
    run = make_run(tmp_path / "run", n=48, shards=[0, 2, 4])
    shutil.copytree(seal(run.storage), tmp_path / "alone.zarr")
    shutil.rmtree(tmp_path / "run/shards/000002")
    sealed = SampleReader([tmp_path / "alone.zarr"], ALL, SAMPLES)
    batches = list(sealed.shards())
    assert [len(b["label"]) for b in batches] == [10, 10, 8]
    assert len(sealed) == 28
    truth = stored_samples(run)
    np.testing.assert_array_equal(
        np.concatenate([b["distance_m"] for b in batches]), truth["distance_m"][:28]
    )


def test_runs_with_other_clouds_are_not_mixed(tmp_path: Path):
    make_run(tmp_path / "a")
    make_run(tmp_path / "b", spec=small_spec(n_points=65))
    with pytest.raises(InputError, match="points_m"):
        SampleReader([tmp_path / "a", tmp_path / "b"])


def test_every_bit_flip_of_a_chunk_is_detected_and_named(tmp_path: Path):
    make_run(tmp_path, n=20)
    rng = np.random.default_rng(3)
    reader = SampleReader([tmp_path], ALL, SAMPLES)
    assert len(list(reader.shards())) == 2  # from here on its own checksum alone guards a file
    for name in (*ALL, *SAMPLES):
        (victim,) = (tmp_path / "shards/000001/a-1" / name).glob("c.*")
        whole = victim.read_bytes()
        for bit in rng.integers(0, 8 * len(whole), 12):
            data = bytearray(whole)
            data[bit // 8] ^= 1 << (bit % 8)
            victim.write_bytes(data)
            with pytest.raises(InputError, match="crc32c") as e:
                list(reader.shards())
            assert e.value.place == str(victim)
        victim.write_bytes(whole)
    assert len(list(reader.shards())) == 2


def test_missing_and_cut_files_are_named(tmp_path: Path):
    make_run(tmp_path, n=20)
    victim = tmp_path / "shards/000000/a-0/label/c.0"
    data = victim.read_bytes()
    reader = SampleReader([tmp_path])
    victim.write_bytes(data[:-3])
    with pytest.raises(InputError, match=r"label/c\.0: label: has \d+ bytes with another sha256"):
        next(reader.shards())
    victim.unlink()
    with pytest.raises(InputError, match=r"label/c\.0: label: no such file"):
        next(reader.shards())
    (tmp_path / "shards/000000/a-0/label/zarr.json").unlink()
    with pytest.raises(InputError, match=r"label/zarr\.json: label: no such file"):
        SampleReader([tmp_path])


def test_unreadable_runs_are_refused(tmp_path: Path):
    make_run(tmp_path / "run", n=20)
    make_run(tmp_path / "bare", n=20, shards=[])
    (tmp_path / "odd.zarr").mkdir()
    cases: list[tuple[list[Path], dict[str, Any], str]] = [
        ([], {}, "no run is given"),
        ([tmp_path / "bare"], {}, "20 of the 20 planned samples are missing"),
        ([tmp_path / "bare"], {"allow_incomplete": True}, "no shard is committed"),
        ([tmp_path / "odd.zarr"], {}, "no such file"),
        ([tmp_path / "none"], {}, "no such folder"),
        ([tmp_path / "run"], {"sample_fields": ("beauty",)}, "beauty: is not a field of the run"),
        ([tmp_path / "run"], {"sample_fields": ("points_m",)}, "points_m: is not a field of samples"),
    ]
    for places, fields, problem in cases:
        with pytest.raises(InputError, match=problem):
            SampleReader(places, **fields)


@pytest.mark.parametrize(
    "text", ["", "{}", "[]", '{"attributes": {}}', '{"attributes": 3}', "[" * 100_000, '{"attributes": null}']
)
def test_a_sealed_store_with_a_broken_root_is_refused(tmp_path: Path, text: str):
    path = Path(seal(make_run(tmp_path, n=20).storage))
    (path / "zarr.json").write_text(text)
    with pytest.raises(InputError, match="not the root of a sealed store"):
        SampleReader([path])


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"float32"', '"float64"'),
        ('"float32"', '"object"'),
        ('"float32"', '"complex64"'),
        ('"little"', '"big"'),
        ('"zstd"', '"gzip"'),
        ('"crc32c"', '"crc32d"'),
        ('"sample"', '"samples"'),
        ('"shape": [\n    20\n  ]', '"shape": [\n    1000000000000\n  ]'),
        ('"chunk_shape": [\n        10\n      ]', '"chunk_shape": [\n        1000000000\n      ]'),
        ('"chunk_shape": [\n        10\n      ]', '"chunk_shape": [\n        0\n      ]'),
        ('"chunk_shape": [\n        10\n      ]', '"chunk_shape": [\n        7\n      ]'),
    ],
)
def test_hostile_metadata_of_a_sealed_store_is_refused(tmp_path: Path, old: str, new: str):
    path = Path(seal(make_run(tmp_path, n=20).storage))
    meta = path / "distance_m" / "zarr.json"
    text = meta.read_text()
    assert old in text
    meta.write_text(text.replace(old, new))
    with pytest.raises(InputError):
        list(SampleReader([path]).shards())


def test_a_run_may_be_named_like_a_store(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run.zarr", n=50)
    seal(run.storage)
    assert len(SampleReader([tmp_path / "run.zarr"])) == 50
    assert len(SampleReader([tmp_path / "run.zarr" / "data.zarr"])) == 50


def test_merged_shards_may_differ_in_descriptions_but_not_in_types(tmp_path: Path):
    run = make_run(tmp_path, n=20, shards=[0])
    scenes, samples = rows_of(run, 1)
    files = encode_shard(run.schema, run.layout, run.manifest.spec_hash, scenes, samples)
    key = "distance_m/zarr.json"
    said = json.loads(files[key])
    said["attributes"]["long_name"] = "how far it is"
    files[key] = json.dumps(said).encode()
    assert run.commit(commit_of(run, 1, "x", run.write_shard(1, "x", files)))
    assert len(ids(list(SampleReader([tmp_path]).shards()))) == 20
    said["shape"] = said["chunk_grid"]["configuration"]["chunk_shape"] = [9]
    files[key] = json.dumps(said).encode()
    (tmp_path / "commits" / "000001.json").unlink()
    assert run.commit(commit_of(run, 1, "y", run.write_shard(1, "y", files)))
    with pytest.raises(InputError, match=r"000001/y/distance_m/zarr\.json: distance_m: differs"):
        SampleReader([tmp_path])


def swap_equal_sizes(run: Run) -> set[str]:
    """Exchange the chunks of equal size, and other bytes, of the first two shards; their columns."""
    swapped: set[str] = set()
    ours, theirs = "shards/000000/a-0", "shards/000001/a-1"
    for file in run.storage.list(ours):
        path = file.key.removeprefix(f"{ours}/")
        one, other = (run.storage.get(f"{folder}/{path}", 2**20) or b"" for folder in (ours, theirs))
        if "/c." in path and len(one) == len(other) and one != other:
            run.storage.put(f"{ours}/{path}", other)
            run.storage.put(f"{theirs}/{path}", one)
            swapped.add(path.partition("/")[0])
    return swapped


@pytest.mark.parametrize("remote", [False, True])
def test_chunks_that_were_swapped_between_shards_are_refused_by_every_reader(
    tmp_path: Path, remote: bool, request: pytest.FixtureRequest
):
    """Each has the right size, and a crc32c of its own that is right."""
    place = f"{request.getfixturevalue('bucket')}/run" if remote else str(tmp_path)
    run = make_run(place, n=20)
    swapped = swap_equal_sizes(run)
    assert {"distance_m", "visibility"} <= swapped
    for name in swapped & {*ALL, *SAMPLES}:
        scenes, samples = ((name,), ()) if name in ALL else ((), (name,))
        with pytest.raises(InputError, match=f"/{name}/c.*: {name}: .*another sha256 than the commit"):
            list(SampleReader([place], scenes, samples).shards())
    readers: list[Callable[[], object]] = [
        lambda: read_labels(run),
        lambda: read_scene(run, 0),
        lambda: list(SampleStream([place]).epoch(0)),
    ]
    for read in readers:
        with pytest.raises(InputError, match="another sha256 than the commit"):
            read()


def test_swapped_metadata_are_refused(tmp_path: Path):
    make_run(tmp_path, n=20)
    folder = tmp_path / "shards/000000/a-0"
    (folder / "distance_m/zarr.json").write_bytes((folder / "visibility/zarr.json").read_bytes())
    with pytest.raises(InputError, match=r"distance_m/zarr\.json: distance_m: .*sha256"):
        SampleReader([tmp_path])


def test_a_file_is_checked_against_its_commit_once_per_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    make_run(tmp_path, n=20)
    hashed: list[int] = []

    def counted(data: bytes) -> Any:
        hashed.append(len(data))
        return sha256(data)

    monkeypatch.setattr(shard_reading, "sha256", counted)
    reader = SampleReader([tmp_path], ("points_m",), ("label",))
    opened = len(hashed)
    first = list(reader.shards())
    assert len(hashed) > opened
    del hashed[:]
    for again, before in zip(reader.shards(), first, strict=True):
        np.testing.assert_array_equal(again["label"], before["label"])
    assert not hashed


def test_an_incomplete_run_is_read_only_with_allow_incomplete(tmp_path: Path):
    make_run(tmp_path, n=30)
    (tmp_path / "commits/000001.json").unlink()
    words = r"10 of the 30 planned samples are missing\. .*resume.*allow an incomplete run"
    for opened in (lambda: SampleReader([tmp_path]), lambda: SampleStream([tmp_path])):
        with pytest.raises(InputError, match=words) as error:
            opened()
        assert error.value.place == str(tmp_path)
    assert len(SampleReader([tmp_path], allow_incomplete=True)) == 20
    assert SampleStream([tmp_path], allow_incomplete=True).n_samples == 20


def test_numbers_that_no_run_stores_are_refused(tmp_path: Path):
    for value in (np.nan, np.inf):
        place = tmp_path / str(value)
        make_stream_run(place, 36, distance_m=value)
        with pytest.raises(InputError, match="distance_m: holds NaN or infinite numbers"):
            list(SampleReader([place], ("house_id",), ("distance_m",)).shards())

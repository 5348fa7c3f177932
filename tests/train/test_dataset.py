"""Streams of batches: every sample once, the same again, from any batch on, and with its own cloud."""

from __future__ import annotations

import threading
from collections.abc import Generator, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen import cli
from datagen.schemas.errors import InputError
from datagen.schemas.fields import SCHEMA_VERSION
from datagen.schemas.run import Run
from datagen.schemas.sealing import seal
from datagen.train.baselines.baseline import mount_m
from datagen.train.dataset import SampleStream
from datagen.train.inputs import Array, Batch
from tests.small_runs import CONFIG, arrays_of, make_small_run
from tests.train.stream_runs import HOUSES, ROBOT_FIELDS, make_stream_run, stream_rows

N, SCENES, SHARDS = 113, 19, 7
OPTIONS = st.fixed_dictionaries({
    "scenes_per_batch": st.integers(1, 8),
    "buffer_shards": st.integers(1, 8),
    "seed": st.integers(0, 2**40),
    "candidates_per_robot": st.none() | st.integers(1, 4),
    "shuffle": st.booleans(),
})  # fmt: skip
few = settings(max_examples=20, deadline=None)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """19 scenes with 2 robots and 6 candidates, the last cut to 5, in 7 shards."""
    return make_stream_run(tmp_path_factory.mktemp("streamed") / "run", N)


@pytest.fixture(scope="module")
def place(run: Run) -> str:
    return run.storage.url


def names(batches: Iterable[Batch[Array]]) -> list[bytes]:
    return [bytes(i) for b in batches for i in b.sample_id]


def columns(batch: Batch[Array]) -> dict[str, Array]:
    """Every array of a batch by its name."""
    tables = (batch.clouds, batch.robots, batch.candidates)
    inner = {name: a for table in tables for name, a in vars(table).items()}
    return {**inner, "label": batch.label, "sample_id": batch.sample_id, **batch.extra}


def assert_same(ours: Batch[Array], theirs: Batch[Array]) -> None:
    a, b = columns(ours), columns(theirs)
    assert a.keys() == b.keys()
    for name in a:
        assert a[name].dtype == b[name].dtype, name
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


def scenes_of(batches: Iterable[Batch[Array]]) -> dict[int, tuple[bytes, ...]]:
    """What each scene gave, by its index: names of samples, cloud, and where its candidates are."""
    given: dict[int, tuple[bytes, ...]] = {}
    for b in batches:
        scene_row = b.robots.cloud_row[b.candidates.robot_row]
        for row, scene in enumerate(b.extra["scene_index"].tolist()):
            mine = scene_row == row
            cloud = (b.clouds.points_m[row], b.clouds.rgb[row], b.clouds.target_mask[row])
            held = (b.sample_id[mine], b.candidates.base_xy_m[mine], *cloud)
            given[scene] = tuple(a.tobytes() for a in held)
    return given


def test_a_batch_has_the_stored_rows_in_the_targets_frame(run: Run, place: str):
    stream = SampleStream([place], scenes_per_batch=4, extra=("distance_m", "house_id", "object_name"))
    assert (stream.n_samples, stream.n_scenes, stream.batches_per_epoch) == (N, SCENES, 5)
    stored: dict[bytes, tuple[dict[str, Any], dict[str, Any]]] = {}
    for shard in range(SHARDS):
        scenes, samples = stream_rows(run, shard)
        for i, name in enumerate(samples["sample_id"]):
            scene = {k: a[i // 6] for k, a in scenes.items()}
            stored[bytes(name)] = scene, {k: a[i] for k, a in samples.items()}
    for b in stream.epoch(0):
        assert b.label.dtype == b.candidates.robot_row.dtype == b.robots.cloud_row.dtype == np.int64
        assert (np.diff(b.candidates.robot_row) >= 0).all()
        assert (np.diff(b.robots.cloud_row) >= 0).all()
        cloud_row = b.robots.cloud_row[b.candidates.robot_row]
        for i, name in enumerate(b.sample_id):
            scene, sample = stored[bytes(name)]
            assert b.label[i] == sample["label"]
            for field in ROBOT_FIELDS:
                assert getattr(b.robots, field)[b.candidates.robot_row[i]] == sample[field]
            offset = sample["base_xy_m"].astype(np.float64) - scene["target_center_m"][:2]
            np.testing.assert_array_equal(b.candidates.base_xy_m[i], offset.astype(np.float32))
            assert b.extra["distance_m"][i] == sample["distance_m"]
            row = cloud_row[i]
            np.testing.assert_array_equal(b.clouds.points_m[row], scene["points_m"].astype(np.float32))
            np.testing.assert_array_equal(b.clouds.rgb[row], scene["rgb"])
            np.testing.assert_array_equal(b.clouds.target_mask[row], scene["target_mask"])
            assert b.clouds.n_points[row] == scene["n_points"]
            assert b.clouds.target_height_m[row] == np.float32(scene["target_center_m"][2])
            assert b.clouds.target_radius_m[row] == scene["target_radius_m"]
            assert b.extra["house_id"][row] == scene["house_id"]
            assert b.extra["object_name"][row].tolist() == scene["object_name"].tolist()


def test_batches_of_a_run_have_the_documented_frames(heuristic_run: Path):
    """Distances that the run stores follow from a batch; its camera sees the cloud."""
    extra = ("mount_distance_m", "T_world_camera", "target_center_m")
    (batch,) = SampleStream([heuristic_run], extra=extra).epoch(0)
    assert len(batch.robots) == 4 * len(batch.clouds) == 48
    distance_m = mount_m(batch)
    np.testing.assert_allclose(distance_m, batch.extra["mount_distance_m"], atol=1e-5)
    for row, n in enumerate(batch.clouds.n_points):
        T = batch.extra["T_world_camera"][row]
        sight_m = batch.clouds.points_m[row, :n] + batch.extra["target_center_m"][row] - T[:3, 3]
        assert (sight_m @ T[:3, 2]).min() > 0.1


@given(OPTIONS, st.integers(1, 4), st.integers(0, 5))
@few
def test_ranks_together_give_every_sample_once(place: str, options: dict[str, Any], world: int, k: int):
    ranks = [SampleStream([place], **options, rank=rank, world=world) for rank in range(world)]
    batches = [list(stream.epoch(k)) for stream in ranks]
    assert {len(some) for some in batches} == {ranks[0].batches_per_epoch}
    seen = [name for some in batches for name in names(some)]
    assert len(seen) == len(set(seen)) == ranks[0].n_samples
    if options["candidates_per_robot"] is None:
        assert len(seen) == N
    for b in (b for some in batches for b in some):
        most = np.bincount(b.candidates.robot_row).max()
        assert options["candidates_per_robot"] is None or most <= options["candidates_per_robot"]


@given(OPTIONS, st.integers(0, 30), st.integers(0, 3))
@few
def test_an_epoch_resumes_at_any_batch(place: str, options: dict[str, Any], skip: int, k: int):
    stream = SampleStream([place], **options)
    whole = list(stream.epoch(k))
    # A stream of its own, as another process would have.
    rest = list(SampleStream([place], **options).epoch(k, skip))
    assert len(rest) == max(0, len(whole) - skip)
    for ours, theirs in zip(rest, whole[skip:], strict=True):
        assert_same(ours, theirs)


@given(OPTIONS, OPTIONS, st.integers(0, 3))
@few
def test_scenes_depend_on_seed_and_epoch_alone(
    place: str, one: dict[str, Any], other: dict[str, Any], k: int
):
    shared = {name: one[name] for name in ("seed", "candidates_per_robot")}
    given = [
        scenes_of(SampleStream([place], **(options | shared), extra=("scene_index",)).epoch(k))
        for options in (one, other)
    ]
    assert given[0] == given[1]


def test_epochs_and_seeds_differ_and_stored_order_does_not(place: str):
    def order(seed: int, k: int, **options: Any) -> list[bytes]:
        return names(SampleStream([place], seed=seed, **options).epoch(k))

    assert order(0, 0) == order(0, 0)
    assert len({tuple(order(*pair)) for pair in ((0, 0), (0, 1), (1, 0))}) == 3
    assert order(0, 0, shuffle=False, buffer_shards=1) == order(1, 2, shuffle=False, buffer_shards=3)
    # Other candidates of a robot every epoch.
    drawn = [order(0, k, shuffle=False, candidates_per_robot=1) for k in (0, 1)]
    assert drawn[0] != drawn[1]
    assert len(drawn[0]) == len(drawn[1]) == 2 * SCENES


def test_skipped_batches_are_not_read(tmp_path: Path):
    folder = tmp_path / "run"
    make_stream_run(folder, 6 * 3 * 6)
    stream = SampleStream([folder], scenes_per_batch=3, buffer_shards=2)
    whole = list(stream.epoch(0))
    first = {bytes(i) for b in whole[:2] for i in b.sample_id}
    run = Run.open(folder)
    for shard in range(6):
        ids = {bytes(i) for i in stream_rows(run, shard)[1]["sample_id"]}
        if ids & first:  # a shard of the first buffer, which is two batches
            (folder / f"shards/a-{shard}.zip").unlink()
    for ours, theirs in zip(stream.epoch(0, 2), whole[2:], strict=True):
        assert_same(ours, theirs)
    with pytest.raises(InputError, match=r"a-\d\.zip: no such file"):
        list(stream.epoch(0, 1))


def test_reading_ahead_is_bounded_and_ends_with_the_iterator(place: str):
    def readers() -> int:
        return sum(thread.name.startswith("read-ahead") for thread in threading.enumerate())

    for close in (Generator.close, list):
        batches = SampleStream([place], scenes_per_batch=2).epoch(0)
        next(batches)
        assert readers() == 1
        close(batches)
        assert readers() == 0


def test_clutter_that_is_absent_is_no_object(tmp_path: Path):
    """Scenes at places have 0 to `n_clutter` objects around the target, and empty names for the others."""
    config = f"{CONFIG}\n[scene]\nn_clutter = 3\n[scene.places]\ntop = 1\n"
    run = make_small_run(tmp_path / "run", 24, per_scene=4, config=config)
    digests = {str(digest) for digest in np.ravel(arrays_of(run)["object_digest"])}
    assert "" in digests and SampleStream([run]).object_digests() == digests - {""}
    # Runs with more or less clutter are read together.
    tops = make_small_run(tmp_path / "tops", 24, "--seed", "1", per_scene=4)
    both = SampleStream([run, tops])
    assert both.object_digests() == digests - {""} | set(np.ravel(arrays_of(tops)["object_digest"]))
    assert sum(len(batch.clouds) for batch in both.epoch(0)) == 12


def test_houses_choose_the_scenes(place: str):
    extra = ("house_id", "scene_index")
    stream = SampleStream([place], houses=lambda house: house in ("house-1", "house-3"), extra=extra)
    assert stream.house_ids() == {"house-1", "house-3"}
    assert {h for b in stream.epoch(0) for h in b.extra["house_id"]} == stream.house_ids()
    assert stream.n_scenes == sum(i % HOUSES in (1, 3) for i in range(SCENES))
    whole = SampleStream([place], extra=extra)
    assert scenes_of(stream.epoch(0)).items() <= scenes_of(whole.epoch(0)).items()
    labels = np.concatenate([b.label for b in whole.epoch(0)])
    assert whole.class_counts() == ((labels == 0).sum(), (labels == 1).sum())
    assert sum(stream.class_counts()) == stream.n_samples
    assert len(whole.house_digests()) == len(whole.house_ids()) == HOUSES


def test_sealed_and_merged_runs_give_the_same_samples(run: Run, place: str, tmp_path: Path):
    other = make_stream_run(tmp_path / "other", 30, seed=5)
    both = SampleStream([place, tmp_path / "other"], shuffle=False)
    assert cli.run(["merge", place, str(tmp_path / "other"), "--out", str(tmp_path / "merged")]) == 0
    merged = SampleStream([tmp_path / "merged"])
    alone = SampleStream([seal(run.storage)], shuffle=False)
    assert names(alone.epoch(0)) == names(SampleStream([place], shuffle=False).epoch(0))
    assert sorted(names(merged.epoch(0))) == sorted(names(both.epoch(0)))
    said = both.origin()
    assert [part["n_samples"] for part in said] == [N, 30]
    assert [part["cost"]["cpu_s"] for part in said] == [SHARDS, len(other.committed())]
    assert sorted(part["samples_sha256"] for part in merged.origin()) == sorted(
        part["samples_sha256"] for part in said
    )
    assert alone.origin() == [said[0] | {"cost": None}]
    assert said[0]["spec_hashes"] == [run.manifest.spec_hash]
    with pytest.raises(InputError, match="samples would occur twice"):
        SampleStream([place, tmp_path / "merged"])


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"scenes_per_batch": 0}, "scenes_per_batch: 0 is below 1"),
        ({"buffer_shards": 0}, "buffer_shards: 0 is below 1"),
        ({"candidates_per_robot": 0}, "candidates_per_robot: 0 is below 1"),
        ({"seed": -1}, "seed: -1 is below 0"),
        ({"rank": 2, "world": 2}, "rank: 2 of 2"),
        ({"world": 20}, "19 scenes for 20 processes"),
        ({"extra": ("beauty",)}, "beauty: is not a field of the run"),
        ({"houses": lambda house: False}, "house_id: has no scene in the selected houses"),
    ],
)
def test_options_out_of_range_are_refused(place: str, changes: dict[str, Any], problem: str):
    with pytest.raises(InputError, match=problem):
        SampleStream([place], **changes)
    with pytest.raises(InputError, match="skip_batches: -1"):
        SampleStream([place]).epoch(0, -1)


def test_invalid_rows_are_refused_with_their_shard(tmp_path: Path):
    make_stream_run(tmp_path / "label", 18, label=2)
    with pytest.raises(InputError, match=r"shards/a-0\.zip: label: a label of 2"):
        SampleStream([tmp_path / "label"])
    for name, changes, problem in (
        ("robots", {"robot_index": 0}, r"\w+_m: differs between samples of one robot"),
        ("points", {"n_points": 65}, r"n_points: is not between 0 and the size"),
        ("scenes", {"sample_scene_index": 7}, r"sample_scene_index: has a sample of a scene"),
    ):
        make_stream_run(tmp_path / name, 18, **changes)
        with pytest.raises(InputError, match=rf"{name}/shards/a-0\.zip: {problem}"):
            list(SampleStream([tmp_path / name]).epoch(0))


def test_runs_of_other_versions_and_parameters_are_refused_by_name(place: str, tmp_path: Path):
    make_stream_run(tmp_path / "more", 18, cloud_points=65)
    with pytest.raises(InputError, match=r"more: points_m: .*\(65, 3\).*\(64, 3\).*equal parameters"):
        SampleStream([place, tmp_path / "more"])
    store = Path(seal(make_stream_run(tmp_path / "older", 18, seed=9).storage))
    root = store / "zarr.json"
    root.write_text(root.read_text().replace(f'"schema_version": {SCHEMA_VERSION}', '"schema_version": 1'))
    with pytest.raises(InputError, match=r"zarr\.json: schema_version: is 'heuristic' 1, but this program"):
        SampleStream([store])

"""Encoded runs give models what plain batches give them, in nested subsets of houses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from datagen.schemas.errors import InputError
from datagen.train.encoded.batches import EncodedBatches, hold_out, house_order, subset_of_houses
from datagen.train.encoded.runs import EncodedRuns, encode_runs, encoded_stream, open_encoded
from datagen.train.encoded.training import scores_of, train_encoded
from datagen.train.models.shared import SharedModel
from datagen.train.scorers import ModelScorer
from datagen.train.training.options import Options
from tests.train.models.made_batches import SMALL
from tests.train.stream_runs import make_stream_run

SMALL_SHARED = SMALL["shared"]


def no_progress(done: int, of: int) -> None:
    assert done <= of


def encoded(run: Path, folder: Path, **changes: object) -> EncodedRuns:
    model = SharedModel({**SMALL_SHARED, **changes})
    return encode_runs(encoded_stream([str(run)], False), model, folder, no_progress)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> EncodedRuns:
    """21 scenes of 7 houses, 2 robots with 3 candidates each."""
    folder = tmp_path_factory.mktemp("encoded")
    make_stream_run(folder / "run", 126)
    return encoded(folder / "run", folder / "encodings")


def test_a_model_scores_encoded_candidates_as_it_scores_clouds(heuristic_run: Path, tmp_path: Path):
    torch.manual_seed(3)
    model = SharedModel(SMALL_SHARED).eval()
    stream = encoded_stream([str(heuristic_run)], False)
    data = encode_runs(stream, model, tmp_path, no_progress)
    batches = list(stream.epoch(0))
    plain = np.concatenate([ModelScorer(model, "model").score(batch) for batch in batches])
    np.testing.assert_allclose(scores_of(model, data), plain, atol=2e-3)  # tokens have half precision
    assert np.ptp(plain) > 0.01
    some = np.array([1, 4, 2])
    chosen = np.concatenate([np.flatnonzero(data.scene_of_candidate == scene) for scene in some])
    np.testing.assert_allclose(scores_of(model, data, some), scores_of(model, data)[chosen], atol=1e-5)
    np.testing.assert_array_equal(data.label, np.concatenate([batch.label for batch in batches]))
    within = [
        (batch.extra["base_is_clear"] == 1)
        & (batch.extra["mount_distance_m"] <= batch.robots.arm_reach_m[batch.candidates.robot_row])
        for batch in batches
    ]
    np.testing.assert_array_equal(data.in_range, np.concatenate(within))


def test_trainings_that_encode_the_same_runs_side_by_side_share_them(tmp_path: Path):
    run, folder = tmp_path / "run", tmp_path / "encodings"
    make_stream_run(run, 126)
    first: list[EncodedRuns] = []

    def overtake(done: int, of: int) -> None:
        if not first:
            first.append(encoded(run, folder))

    model = SharedModel(SMALL_SHARED)
    second = encode_runs(encoded_stream([str(run)], False), model, folder, overtake)
    assert [place.name for place in folder.iterdir()] == [second.key] == [first[0].key]
    np.testing.assert_array_equal(second.label, first[0].label)


def test_batches_in_any_order_hold_the_scenes_that_were_asked_for(data: EncodedRuns):
    chosen = np.array([17, 3, 9, 4])
    batch = data.batch(chosen)
    whole = data.batch(np.arange(len(data.houses)))
    per_scene = len(data.label) // len(data.houses)
    rows = np.concatenate([np.arange(k * per_scene, (k + 1) * per_scene) for k in chosen])
    np.testing.assert_array_equal(batch.sample_id, whole.sample_id[rows])
    np.testing.assert_array_equal(batch.candidates.base_xy_m, whole.candidates.base_xy_m[rows])
    robots = batch.candidates.robot_row
    for name in ("arm_reach_m", "base_height_m"):
        of_whole = getattr(whole.robots, name)[whole.candidates.robot_row][rows]
        np.testing.assert_array_equal(getattr(batch.robots, name)[robots], of_whole)
    np.testing.assert_array_equal(batch.robots.cloud_row[robots], np.repeat(np.arange(4), per_scene))


def test_an_epoch_has_every_scene_once_and_another_order_each_time(data: EncodedRuns):
    scenes = np.arange(0, 21, 2)
    batches = EncodedBatches(data, scenes, 4, seed=5)

    def ids(k: int) -> list[bytes]:
        return [row.tobytes() for batch in batches.epoch(k) for row in batch.sample_id]

    assert len(list(batches.epoch(0))) == batches.batches_per_epoch == 3
    assert sorted(ids(0)) == sorted(ids(1)) and ids(0) != ids(1) and ids(0) == ids(0)
    assert len(ids(0)) == batches.n_samples == sum(batches.class_counts()) == 11 * 6


def test_larger_shares_hold_the_houses_of_smaller_ones_and_seeds_differ(data: EncodedRuns):
    subsets = [set(subset_of_houses(data, share, 1).tolist()) for share in (0.2, 0.5, 1.0)]
    assert subsets[0] < subsets[1] < subsets[2] == set(range(21))
    houses = {str(data.houses[scene]) for scene in subsets[1]}
    assert {k for k in range(21) if str(data.houses[k]) in houses} == subsets[1]
    assert len({tuple(house_order(data.houses, seed)) for seed in range(5)}) > 1


def test_held_out_houses_are_in_no_training(data: EncodedRuns):
    train, held = hold_out(data, subset_of_houses(data, 0.5, 1), 1)
    assert set(data.houses[train]).isdisjoint(data.houses[held]) and len(held) and len(train)
    many = EncodedRuns("key", data.tokens, {**data.columns, "house": np.array([f"h{k}" for k in range(21)])})
    train, held = hold_out(many, np.arange(21), 1)
    assert len(held) == 2 and len(train) == 19


def test_encodings_are_made_once_and_again_for_other_tokens_or_samples(tmp_path: Path):
    make_stream_run(tmp_path / "run", 36)
    make_stream_run(tmp_path / "other", 36, seed=1)
    first = encoded(tmp_path / "run", tmp_path / "e")
    changed = (tmp_path / "e" / first.key / "tokens.f16").stat().st_mtime_ns
    assert encoded(tmp_path / "run", tmp_path / "e", width=8).key == first.key
    assert (tmp_path / "e" / first.key / "tokens.f16").stat().st_mtime_ns == changed
    others = {encoded(tmp_path / "run", tmp_path / "e", tokens=(4, 4, 4)).key}
    others.add(encoded(tmp_path / "other", tmp_path / "e").key)
    assert len(others | {first.key}) == 3
    assert sorted(p.name for p in (tmp_path / "e").iterdir()) == sorted(others | {first.key})


@pytest.mark.parametrize("file", ["tokens.f16", "columns.npz"])
def test_a_damaged_encoding_is_named(file: str, tmp_path: Path):
    make_stream_run(tmp_path / "run", 36)
    key = encoded(tmp_path / "run", tmp_path / "e").key
    place = tmp_path / "e" / key
    (place / file).write_bytes((place / file).read_bytes()[:100])
    with pytest.raises(InputError, match=rf"{key}.*is damaged.*Remove this folder"):
        open_encoded(place)


def test_equal_trainings_give_equal_weights_and_begin_from_what_they_are_given(data: EncodedRuns):
    options = Options("sim-only", "shared", SMALL_SHARED, epochs=2, batch_scenes=4)
    scenes, judged = hold_out(data, np.arange(21), 0)

    def trained(**changes: object):
        batches = EncodedBatches(data, scenes, 4, seed=0), EncodedBatches(data, judged, 4)
        found = train_encoded(options, *batches, changes.get("init"), lambda: False)  # type: ignore[arg-type]
        assert found is not None and 1 <= found.best_epoch <= 2
        return found.model

    first, again = trained(), trained()
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), again.parameters(), strict=True))
    other = trained(init=first.state_dict())
    assert not all(torch.equal(a, b) for a, b in zip(first.parameters(), other.parameters(), strict=True))
    both = EncodedBatches(data, scenes, 4, seed=0), EncodedBatches(data, judged, 4)
    assert train_encoded(options, *both, None, lambda: True) is None

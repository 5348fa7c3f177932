"""Encoded runs give models what plain batches give them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from datagen.schemas.errors import InputError
from datagen.train.encoded_runs import (
    EncodedBatches,
    EncodedRuns,
    encode_runs,
    encoded_stream,
    open_encoded,
)
from datagen.train.models.shared import SharedModel
from datagen.train.scorers import ModelScorer
from tests.sim_extra import needs_sim
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


@pytest.mark.parametrize("kinematics", [False, pytest.param(True, marks=needs_sim)])
def test_a_model_scores_encoded_candidates_as_it_scores_clouds(
    kinematics: bool, heuristic_run: Path, tmp_path: Path
):
    torch.manual_seed(3)
    model = SharedModel({**SMALL_SHARED, "kinematics": kinematics}).eval()
    stream = encoded_stream([str(heuristic_run)], False)
    data = encode_runs(stream, model, tmp_path, no_progress)
    batches = list(stream.epoch(0))
    plain = np.concatenate([ModelScorer(model, "model").score(batch) for batch in batches])
    again = EncodedBatches(data, np.arange(len(data.houses)), 4).epoch(0)
    scores = np.concatenate([ModelScorer(model, "model").score(batch) for batch in again])
    np.testing.assert_allclose(scores, plain, atol=2e-3)  # tokens have half precision
    assert np.ptp(plain) > 0.01
    np.testing.assert_array_equal(data.columns["label"], np.concatenate([batch.label for batch in batches]))
    plainly = encode_runs(
        encoded_stream([str(heuristic_run)], False), SharedModel(SMALL_SHARED), tmp_path, no_progress
    )
    assert (plainly.key == data.key) is not kinematics


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
    np.testing.assert_array_equal(second.columns["label"], first[0].columns["label"])


def test_batches_in_any_order_hold_the_scenes_that_were_asked_for(data: EncodedRuns):
    chosen = np.array([17, 3, 9, 4])
    batch = data.batch(chosen)
    whole = data.batch(np.arange(len(data.houses)))
    per_scene = len(data.columns["label"]) // len(data.houses)
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
    assert len(ids(0)) == 11 * 6


def test_encodings_are_made_once_and_again_for_other_tokens_or_samples(tmp_path: Path):
    make_stream_run(tmp_path / "run", 36)
    make_stream_run(tmp_path / "other", 36, seed=1)
    first = encoded(tmp_path / "run", tmp_path / "e")
    tokens = tmp_path / "e" / first.key / "tokens.f16"
    changed = tokens.stat().st_mtime_ns
    assert encoded(tmp_path / "run", tmp_path / "e", width=8).key == first.key
    assert tokens.stat().st_mtime_ns == changed
    others = {encoded(tmp_path / "run", tmp_path / "e", tokens=(4, 4, 4)).key}
    others.add(encoded(tmp_path / "other", tmp_path / "e").key)
    assert len(others | {first.key}) == 3
    assert sorted(p.name for p in (tmp_path / "e").iterdir()) == sorted(others | {first.key})
    for key, file in zip(others, ("tokens.f16", "columns.npz"), strict=True):  # one that is damaged is named
        place = tmp_path / "e" / key
        (place / file).write_bytes((place / file).read_bytes()[:100])
        with pytest.raises(InputError, match=rf"{key}.*is damaged.*Remove this folder"):
            open_encoded(place)

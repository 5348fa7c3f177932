"""Stored scenes made whole again: nonsense is named and refused before anything is worked out from it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from datagen.schemas.errors import InputError
from datagen.schemas.fields import SceneRows
from datagen.schemas.run import Run
from datagen.schemas.shard_reading import read_scenes
from datagen.workers.scenes.reconstruct import ReconstructedScene, reconstruct_candidates, reconstruct_scene
from datagen.workers.world import World, open_world
from tests.small_runs import PER_SCENE, make_small_run

Stored = tuple[World, SceneRows]


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Stored:
    run = Run.open(make_small_run(tmp_path_factory.mktemp("recall") / "run", PER_SCENE))
    return open_world(run.manifest.spec, "builtin", "builtin"), next(read_scenes(run, [0]))


def changed(values: Any, at: Any, value: Any) -> Any:
    """A copy with another value somewhere."""
    values = np.array(values)
    values[at] = value
    return values


def refusal(world: World, rows: SceneRows, record: dict[str, Any], samples: dict[str, Any]) -> str:
    with pytest.raises(InputError) as error:
        scene = reconstruct_scene(world, {**rows.record, **record})
        reconstruct_candidates({**rows.samples, **samples}, scene)
    return str(error.value)


def test_a_sound_scene_is_the_stored_one(stored: Stored) -> None:
    world, rows = stored
    scene = reconstruct_scene(world, rows.record)
    assert isinstance(scene, ReconstructedScene)
    np.testing.assert_array_equal(scene.T_world_object, rows.record["T_world_object"])
    candidates = reconstruct_candidates(rows.samples, scene)
    np.testing.assert_array_equal(candidates.clearance_m, rows.samples["base_clearance_m"])


@pytest.mark.parametrize(
    ("name", "at", "value"),
    [
        ("T_world_object", (0, 0, 3), np.nan),
        ("T_world_object", (2, 0, 3), 1e6),
        ("T_world_object", (1, slice(0, 3), slice(0, 3)), 0.0),  # no rotation
        ("T_world_object", (0, slice(0, 3), slice(0, 3)), 2 * np.eye(3)),
        ("T_world_object", (0, slice(0, 3), slice(0, 3)), np.diag([1.0, 1.0, -1.0])),  # a mirror
        ("T_world_object", (0, 3), 7.0),
        ("T_world_camera", (0, 0), np.nan),
        ("intrinsics_px", 0, 0.0),
        ("intrinsics_px", 2, np.nan),
        ("image_size_px", 0, 100_000),
        ("target_center_m", 0, 900.0),
        ("retry", (), -1),
        ("scene_index", (), -1),
    ],
)
def test_impossible_records_are_refused_by_name(stored: Stored, name: str, at: Any, value: Any) -> None:
    world, rows = stored
    told = refusal(world, rows, {name: changed(rows.record[name], at, value)}, {})
    assert told.startswith("stored scenes: scene ") and name in told and "Make the run" in told


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("base_xy_m", np.nan),
        ("base_xy_m", 900.0),
        ("robot_index", -1),
        ("camera_height_m", np.inf),
        ("base_height_m", -1.0),
        ("arm_reach_m", 1e9),
        ("arm_reach_m", -0.5),
        ("base_clearance_m", np.nan),
        ("base_clearance_m", -np.inf),
    ],
)
def test_impossible_candidates_are_refused_by_name(stored: Stored, name: str, value: float) -> None:
    world, rows = stored
    told = refusal(world, rows, {}, {name: changed(rows.samples[name], 1, value)})
    assert told.startswith("stored scenes: scene 0, ") and name in told


def test_missing_or_changed_sources_are_refused_by_name(stored: Stored) -> None:
    world, rows = stored
    names = changed(rows.record["object_name"], 0, "nonesuch")
    assert "nonesuch" in refusal(world, rows, {"object_name": names}, {})
    assert "nowhere" in refusal(world, rows, {"house_id": "nowhere"}, {})
    assert "digest" in refusal(world, rows, {"house_digest": "0" * 64}, {})
    digests = changed(rows.record["object_digest"], 2, "0" * 64)
    assert "digest" in refusal(world, rows, {"object_digest": digests}, {})

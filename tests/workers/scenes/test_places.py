"""Whole scenes at every kind of place: objects at rest where the place is, and rows that are read again."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.schemas.fields import SceneRows
from datagen.schemas.specification import (
    DECISIVE_SHARES,
    PLACE_KINDS,
    ArmParams,
    CandidateParams,
    GraspParams,
    ObservationParams,
    PlaceKind,
    Places,
    SceneParams,
    Source,
    Specification,
)
from datagen.workers.houses import open_houses
from datagen.workers.objects import open_objects
from datagen.workers.run_shard import MOST_DECISIVE_DRAWS, run_shard
from datagen.workers.scenes import generate
from datagen.workers.scenes.reconstruct import reconstruct_scene
from datagen.workers.world import World, assemble_world


def world_of(scene: SceneParams, **changes: object) -> World:
    houses, objects = open_houses("builtin:40"), open_objects("builtin")
    fields: dict[str, object] = {
        "houses": Source(kind=houses.kind, digest=houses.digest),
        "objects": Source(kind=objects.kind, digest=objects.digest),
        "scene": scene,
        "candidates": CandidateParams(per_scene=6, within="in-range"),
        "observation": ObservationParams(n_points=64),
    }
    spec = Specification.model_validate(fields | changes)
    return assemble_world(spec, houses, objects, "builtin:40", "builtin")


@pytest.mark.parametrize("kind", PLACE_KINDS)
def test_objects_rest_at_the_place_and_the_scene_is_read_again(kind: PlaceKind) -> None:
    world = world_of(SceneParams(places=Places.model_validate({kind: 1.0}), n_clutter=5))
    made = run_shard(world.spec, world, [0, 1, 2])
    assert (made.scene["place"] == PLACE_KINDS.index(kind)).all()
    alone = run_shard(world.spec, world, [1])  # no matter what else is in the shard
    for row in range(3):
        record = {name: column[row] for name, column in made.scene.items()}
        scene = reconstruct_scene(world, record)
        count = sum(name != "" for name in record["object_name"])
        assert 1 <= count == len(scene.models) <= 6
        height_m = record["T_world_support"][2, 3]
        for model, T in zip(scene.models, scene.T_world_object, strict=True):
            lowest_m = min(float((part @ T[2, :3]).min()) for part in model.convex_parts_m) + T[2, 3]
            assert lowest_m > height_m - 0.05  # it has not fallen through
        assert record["penetration_m"] <= 0.005
        if row == 1:
            for name, column in made.scene.items():
                np.testing.assert_array_equal(column[1], alone.scene[name][0])
    rows = SceneRows({name: column[0] for name, column in made.scene.items()}, _samples(made.sample, 0))
    again = run_shard(world.spec, world, [0], [rows])
    np.testing.assert_array_equal(again.sample["label"], rows.samples["label"])


def _samples(columns: dict[str, np.ndarray], scene: int) -> dict[str, np.ndarray]:
    own = columns["sample_scene_index"] == scene
    return {name: column[own] for name, column in columns.items()}


def test_houses_seen_to_lack_a_place_are_not_loaded_for_it_again(monkeypatch: pytest.MonkeyPatch) -> None:
    world = world_of(
        SceneParams(places=Places(top=1.0), support_height_m={"low": 0.95, "high": 1.0}, n_clutter=1)
    )
    first, loaded = run_shard(world.spec, world, [0, 1, 2, 3]), list[str]()
    lacking = {house_id for house_id, kinds in world.lacking.items() if "top" in kinds}
    assert lacking and first.redraws["no_surface"] >= len(lacking)
    monkeypatch.setattr(
        World,
        "house",
        lambda self, house_id, load=World.house: loaded.append(house_id) or load(self, house_id),
    )
    again = run_shard(world.spec, world, [0, 1, 2, 3])
    assert loaded and not lacking & set(loaded)
    assert again.redraws == first.redraws
    for name, column in first.scene.items():
        np.testing.assert_array_equal(again.scene[name], column, err_msg=name)


def test_decisive_scenes_are_drawn_until_their_share_is_between_the_limits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    observed, draw = list[float](), generate.observe_cloud
    monkeypatch.setattr(generate, "observe_cloud", lambda *args: observed.append(1.0) or draw(*args))
    world = world_of(
        SceneParams(places=Places(seat=1.0), decisive=1.0, n_clutter=3),
        label_source="plan",
        arm=ArmParams(robot="panda", grasps=GraspParams(per_object=24, per_scene=12)),
        candidates=CandidateParams(
            per_scene=10, within="in-range", arm_reach_m={"low": 0.947, "high": 0.947}
        ),
    )
    world.object_names = [
        "005_tomato_soup_can",
        "009_gelatin_box",
        "013_apple",
        "077_rubiks_cube",
    ]  # the grasps of each take seconds
    made = run_shard(world.spec, world, [0, 5])
    shares, draws = made.scene["good_share"], made.scene["decisive_draws"]
    assert len(observed) == 2 < draws.sum()  # scenes that are not kept are not observed
    for row, scene in enumerate((0, 5)):
        labels = _samples(made.sample, scene)["label"]
        assert 1 <= draws[row] <= MOST_DECISIVE_DRAWS
        within = DECISIVE_SHARES[0] <= shares[row] <= DECISIVE_SHARES[1]
        assert within or draws[row] == MOST_DECISIVE_DRAWS
        assert 0 < labels.mean() <= shares[row] + 1e-6
    free = world_of(world.spec.scene.model_copy(update={"decisive": 0.0}))
    assert (run_shard(free.spec, free, [0]).scene["decisive_draws"] == 0).all()

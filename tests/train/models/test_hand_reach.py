"""The shared model with a robot's own arm and hand as inputs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from datagen.schemas.errors import InputError
from datagen.train.hands.poses import HAND_WIDTH, hand_poses
from datagen.train.hands.reach import hand_reach
from datagen.train.hands.sizes import FRANKA, hand_size
from datagen.train.models import Model, build_model
from datagen.train.models.shared import SharedModel, with_reach
from datagen.train.tensors import on_cpu
from datagen.train.training.checkpoints import read_checkpoint
from datagen.train.training.training_setup import prepare_training
from datagen.workers.motion.pose_reach import N_STAGES
from tests.sim_extra import needs_robots, needs_sim
from tests.train.models.made_batches import SMALL, Tables, drawn_tables, small_model, turned_about_z
from tests.train.models.test_hand_poses import box, table
from tests.train.training.small import TINY, job_of, train_until


@pytest.fixture(scope="module")
def model() -> Model:
    return small_model("shared", kinematics=True)


def named(tables: Tables, *names: str) -> Tables:
    clouds, candidates, robots = tables
    of_robots = np.array([names[int(row) % len(names)] for row in robots.cloud_row], np.str_)
    return clouds, candidates, replace(robots, name=of_robots)


@needs_sim
@pytest.mark.parametrize("name", ["panda", "panda-scaled"])
def test_the_franka_hand_is_that_of_models_without_kinematics(name: str) -> None:
    assert hand_size(name) == FRANKA


@needs_robots
def test_another_hand_is_laid_at_the_target_by_its_own_sizes() -> None:
    fetch, stretch = hand_size("fetch"), hand_size("stretch3")
    assert fetch.stroke_m == pytest.approx(0.1) and fetch.tip_m == pytest.approx(0.031, abs=0.001)
    assert stretch.palm_near_m == pytest.approx(-0.128, abs=0.001)
    found = [hand_poses(table(), box(), 104, size) for size in (FRANKA, fetch, stretch)]
    assert len({poses.tobytes() for poses in found}) == 3
    # The box is 10 cm high and 16 cm wide: between which fingers it fits is their stroke's to say.
    openings = [10 * poses[:, 2].max() / 100 for poses in found]
    np.testing.assert_allclose(openings, [0.08, 0.1, 0.16], atol=0.03)


def test_the_configuration_without_it_is_that_of_older_checkpoints() -> None:
    plain, off = SharedModel(SMALL["shared"]), SharedModel({**SMALL["shared"], "kinematics": False})
    assert plain.config == off.config and "kinematics" not in plain.config
    assert SharedModel({**SMALL["shared"], "kinematics": True}).config["kinematics"] is True
    with pytest.raises(InputError, match="kinematics needs hand_poses"):
        SharedModel({**SMALL["shared"], "kinematics": True, "hand_poses": 0})


@needs_sim
@torch.no_grad()
def test_an_unknown_robot_is_a_scaled_panda_and_a_plain_model_reads_no_robot(model: Model) -> None:
    tables = drawn_tables(3)
    unknown = model.score(*tables)
    assert torch.equal(model.score(*named(tables, "")), unknown)
    assert torch.equal(model.score(*named(tables, "panda-scaled")), unknown)
    plain = small_model("shared")
    assert torch.equal(plain.score(*named(tables, "no such robot")), plain.score(*tables))
    with pytest.raises(InputError, match="no such robot"):
        model.score(*named(tables, "no such robot"))


@needs_sim
@torch.no_grad()
def test_a_model_gets_it_without_a_change_of_its_scores() -> None:
    tables, plain = drawn_tables(3), small_model("shared")
    before = plain.score(*tables)
    model = build_model("shared", {**plain.config, "kinematics": True}).eval()
    model.load_state_dict(with_reach(plain.state_dict()))
    torch.testing.assert_close(model.score(*tables), before)
    again = with_reach(model.state_dict())
    assert all(torch.equal(again[name], tensor) for name, tensor in model.state_dict().items())


@needs_sim
def test_further_training_may_add_it_and_changes_no_other_size(
    heuristic_run: Path, sim_run: Path, tmp_path: Path
) -> None:
    plain, wider = {**TINY, "hand_poses": 8}, {**TINY, "hand_poses": 8, "kinematics": True}
    job = job_of(heuristic_run, tmp_path / "first", model_config=plain, epochs=1)
    assert train_until(job)[0]
    more: dict[str, Any] = {"stage": "stage2", "epochs": 1}
    init = {"init": job.out}
    training, head = prepare_training(
        replace(job_of(sim_run, tmp_path / "a", model_config=wider, **more), **init)
    )
    began = read_checkpoint(job.out).weights
    for name, tensor in training.model.state_dict().items():
        assert torch.equal(tensor, with_reach(began)[name]), name
    assert head.model_config["kinematics"] is True
    other = job_of(sim_run, tmp_path / "b", model_config={**wider, "width": 8}, **more)
    with pytest.raises(InputError, match="kinematics=true may be added"):
        prepare_training(replace(other, **init))


@needs_robots
@torch.no_grad()
def test_the_arm_the_hand_and_the_heading_change_logits(model: Model) -> None:
    tables = named(drawn_tables(3), "tiago-pro")
    before = model.score(*tables)
    clouds, candidates, robots = tables
    aside = replace(candidates, turn_rad=torch.full((len(candidates),), 2.5))
    others = [model.score(*named(tables, name)) for name in ("ur5", "fetch")]
    for after in (*others, model.score(clouds, aside, robots)):
        assert float((after - before).abs().amax()) > 1e-4


@needs_sim
@pytest.mark.parametrize("angle", [0.3, -2.0, 4.0])
def test_codes_turn_with_the_scene_and_a_far_base_has_none(angle: float) -> None:
    clouds, candidates, robots = tables = drawn_tables(7, candidates=60)
    turned_clouds, elsewhere, _ = turned_about_z(tables, angle)
    poses = np.stack([hand_poses(table(), box(seen), 64) for seen in (0.4, 1.5)])
    c, s = np.cos(angle), np.sin(angle)
    turned = poses.copy()
    axes = turned[..., HAND_WIDTH - 9 :].reshape(2, 64, 3, 3)
    axes[...] = axes @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], np.float32)
    rise = np.array([0.1, 0.2, 0.3], np.float32)
    codes = hand_reach(poses, on_cpu(clouds), on_cpu(robots), on_cpu(candidates), rise)[..., :N_STAGES]
    codes = codes.astype(float)
    after = hand_reach(turned, on_cpu(turned_clouds), on_cpu(robots), on_cpu(elsewhere), rise)[..., :N_STAGES]
    assert 0.2 < (codes > 0).mean() < 1 and np.ptp(codes) > 50
    # A pose at the border of two cells may fall into the other one.
    assert (np.abs(after - codes) > 1).mean() < 0.01
    far = replace(candidates, base_xy_m=candidates.base_xy_m + 5.0)
    assert not hand_reach(poses, on_cpu(clouds), on_cpu(robots), on_cpu(far), rise).any()

"""What reaches the models: one table of changes, the same answers for all of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from datagen.train.inputs import CandidateInputs, Clouds, RobotInputs
from datagen.train.models import MODELS, Model
from tests.train.models.made_batches import REACH_M, Tables, drawn_tables, small_model

# `paper` cannot be told where the camera is: given the same, `shared` has to do without, too.
ALIKE: dict[str, dict[str, str]] = {"paper": {}, "shared": {"camera": "unknown"}, "n2m": {}}


def changed(tables: Tables, **fields: Tensor) -> Tables:
    """The tables with other values in some of their fields."""
    clouds, candidates, robots = (
        replace(table, **{name: value for name, value in fields.items() if hasattr(table, name)})
        for table in tables
    )
    return clouds, candidates, robots


def a_point_shifted(points_m: Tensor, target_mask: Tensor) -> Tensor:
    shifted = points_m.clone()
    shifted[0, int((~target_mask[0]).nonzero()[0])] += torch.tensor([0.03, -0.02, 0.04])
    return shifted


# What is changed, into what, and whether logits must differ.
Change = Callable[[Clouds[Tensor], CandidateInputs[Tensor], RobotInputs[Tensor]], dict[str, Tensor]]
CHANGES: dict[str, tuple[Change, bool]] = {
    "a point": (lambda c, b, r: {"points_m": a_point_shifted(c.points_m, c.target_mask)}, True),
    "the target": (lambda c, b, r: {"target_mask": ~c.target_mask}, True),
    "colours": (lambda c, b, r: {"rgb": 255 - c.rgb}, True),
    "colours of the target, which has its own": (
        lambda c, b, r: {"rgb": torch.where(c.target_mask[..., None], 255 - c.rgb, c.rgb)},
        False,
    ),
    "candidates": (lambda c, b, r: {"base_xy_m": b.base_xy_m + 0.05}, True),
    "the mount": (lambda c, b, r: {"base_height_m": r.base_height_m + 0.1}, True),
    "mount and target, where heights count from the mount": (
        lambda c, b, r: {
            "base_height_m": r.base_height_m + 0.25,
            "target_height_m": c.target_height_m + 0.25,
        },
        False,
    ),
    "the camera": (lambda c, b, r: {"camera_height_m": r.camera_height_m + 0.2}, False),
    "the arm": (lambda c, b, r: {"arm_reach_m": r.arm_reach_m / 3}, True),
    "the radius, which is taken from the points": (
        lambda c, b, r: {"target_radius_m": c.target_radius_m * 1.5},
        False,
    ),
}


@pytest.fixture(scope="module", params=sorted(MODELS))
def model(request: pytest.FixtureRequest) -> Model:
    return small_model(request.param, **ALIKE[request.param])


@pytest.mark.parametrize(("change", "seen"), CHANGES.values(), ids=list(CHANGES))
@torch.no_grad()
def test_all_models_see_the_same(model: Model, change: Change, seen: bool):
    tables = drawn_tables(5)
    before, after = model.score(*tables), model.score(*changed(tables, **change(*tables)))
    if seen:
        assert float((after - before).abs().amax()) > 1e-4
    else:
        torch.testing.assert_close(after, before, atol=1e-5, rtol=1e-5)


@torch.no_grad()
def test_points_stored_after_as_many_within_reach_as_a_model_takes_do_not_matter(model: Model):
    assert model.config["n_points"] == 96
    tables = drawn_tables(5, points=160)
    late = torch.cat([torch.arange(96), 96 + torch.randperm(64)])
    shuffled = {name: getattr(tables[0], name)[:, late] for name in ("points_m", "rgb", "target_mask")}
    before, after = model.score(*tables), model.score(*changed(tables, **shuffled))
    torch.testing.assert_close(after, before, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("name", sorted(MODELS))
@torch.no_grad()
def test_points_out_of_reach_change_nothing(name: str):
    """Stored points beyond the reach, before and between those within, take another place and colour."""
    model, tables = small_model(name, n_points=200), drawn_tables(6)
    points_m, rgb, target_mask = (getattr(tables[0], n).clone() for n in ("points_m", "rgb", "target_mask"))
    points_m[:, ::7] *= 3 * REACH_M / points_m[:, ::7].norm(dim=2, keepdim=True)
    target_mask[:, ::7] = True
    logits = []
    for colour in (7, 200):
        rgb[:, ::7], points_m[:, ::7] = colour, 3.0 * points_m[:, ::7]
        far = changed(tables, points_m=points_m, rgb=rgb, target_mask=target_mask)
        logits.append(model.score(*far))
    assert torch.equal(*logits)


@torch.no_grad()
def test_a_given_camera_changes_logits():
    model, tables = small_model("shared", camera="given"), drawn_tables(5)
    higher = changed(tables, camera_height_m=tables[2].camera_height_m + 0.2)
    assert float((model.score(*higher) - model.score(*tables)).abs().amax()) > 1e-4

"""What every model keeps: order, company and odd clouds make no difference; configurations are checked."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import pytest
import torch

from datagen.schemas.errors import InputError
from datagen.train.models import MODELS, build_model
from tests.train.models.made_batches import drawn_tables, small_model

NAMES = sorted(MODELS)


@pytest.mark.parametrize("name", NAMES)
@torch.no_grad()
def test_a_candidate_is_scored_the_same_in_any_order_and_alone(name: str):
    model = small_model(name)
    clouds, candidates, robots = drawn_tables(2, candidates=70)
    logits = model.score(clouds, candidates, robots)
    assert logits.dtype == torch.float32
    order = torch.randperm(70, generator=torch.Generator().manual_seed(0))
    permuted = rows_of(candidates, order)
    torch.testing.assert_close(model.score(clouds, permuted, robots), logits[order], atol=1e-5, rtol=1e-5)
    first = torch.zeros(1, dtype=torch.int64)
    for row in (0, 33, 69):
        robot = candidates.robot_row[[row]]
        one = replace(rows_of(candidates, torch.tensor([row])), robot_row=first)
        alone = replace(rows_of(robots, robot), cloud_row=first)
        seen = rows_of(clouds, robots.cloud_row[robot])
        torch.testing.assert_close(model.score(seen, one, alone), logits[[row]], atol=1e-5, rtol=1e-5)


def rows_of(table: Any, rows: torch.Tensor) -> Any:
    """Some rows of a table, in this order."""
    return replace(table, **{name: v[rows] for name, v in vars(table).items() if v is not None})


@pytest.mark.parametrize("name", NAMES)
def test_odd_clouds_give_finite_logits_and_gradients(name: str):
    model = small_model(name).train()
    clouds, candidates, robots = drawn_tables(3, scenes=5, robots=7, candidates=12)
    clouds.target_mask[2] = False
    clouds.target_mask[3] = True
    clouds = replace(clouds, n_points=torch.tensor([0, 1, 96, 96, 2]))
    candidates.base_xy_m[:2] = 0.0  # right below the target
    robots.arm_reach_m[4] = 0.0
    # Robot 6 has no candidate.
    candidates = replace(candidates, robot_row=torch.arange(12) % 6)
    logits = model.score(clouds, candidates, robots)
    assert torch.isfinite(logits).all()
    torch.nn.functional.cross_entropy(logits, torch.arange(12) % 2).backward()
    for parameter in model.parameters():
        assert parameter.grad is not None
        assert torch.isfinite(parameter.grad).all()


@pytest.mark.parametrize("name", NAMES)
def test_a_batch_of_one_candidate_trains(name: str):
    model = small_model(name).train()
    logits = model.score(*drawn_tables(0, candidates=1))
    logits[0, 1].backward()
    assert torch.isfinite(logits).all()
    assert all(module.training for module in model.modules())


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("sizes", [{"candidates": 0}, {"candidates": 0, "robots": 0}, {"points": 0}])
@torch.no_grad()
def test_empty_tables_are_scored(name: str, sizes: dict[str, int]):
    logits = small_model(name).score(*drawn_tables(0, **{"robots": 3, **sizes}))
    assert logits.shape == (sizes.get("candidates", 9), 2)
    assert torch.isfinite(logits).all()


@pytest.mark.parametrize("name", NAMES)
def test_a_configuration_that_went_through_json_builds_the_same_model(name: str):
    model = small_model(name)
    again = build_model(model.name, json.loads(json.dumps(model.config)))
    again.load_state_dict(model.state_dict())
    again.eval()
    assert again.config == model.config
    with torch.no_grad():
        assert torch.equal(again.score(*drawn_tables(4)), model.score(*drawn_tables(4)))


@pytest.mark.parametrize(
    ("name", "config", "words"),
    [
        ("papre", {}, "papre: is unknown"),
        ("shared", {"widht": 4}, "widht"),
        ("shared", {"width": 10**9}, "width"),
        ("shared", {"scales_m": [0.1] * 1000}, "scales_m"),
        ("shared", {"camera": "mine"}, "camera"),
        ("paper", {"radii_m": [0.2, float("nan")]}, "radii_m.1"),
        ("paper", {"head": [4096] * 100}, "head"),
        ("paper", {"dropout": 1.0}, "dropout"),
    ],
)
def test_an_invalid_configuration_names_its_field(name: str, config: dict[str, Any], words: str):
    with pytest.raises(InputError, match=words):
        build_model(name, config)


@pytest.mark.parametrize("name", NAMES)
@torch.no_grad()
def test_a_temperature_divides_logits_and_leaves_the_model_as_it_is(name: str):
    model, other = small_model(name), small_model(name)
    given = drawn_tables(4, candidates=30)
    before = model.score(*given)
    other.load_state_dict(model.tempered(2.5))
    has_layer = model.logit_layer is not None
    assert has_layer == (name != "n2m")  # whose logits are of a density
    torch.testing.assert_close(
        other.score(*given), before / 2.5 if has_layer else before, atol=1e-6, rtol=1e-5
    )
    assert torch.equal(model.score(*given), before)

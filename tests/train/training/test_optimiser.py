"""The rate's way up and down, what decay acts on, and an optimiser's state as tensors."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from datagen.schemas.errors import InputError
from datagen.train.models import Model, build_model
from datagen.train.training.loop import (
    make_optimiser,
    optimiser_tensors,
    put_optimiser_tensors,
    rate_at,
    set_rate,
)
from tests.train.training.small import TINY, equal


@given(st.integers(1, 500), st.floats(1e-6, 1.0), st.floats(0, 1))
def test_the_rate_rises_to_its_highest_and_falls_to_a_hundredth(steps: int, highest: float, warmup: float):
    rates = [rate_at(step, steps, highest, warmup) for step in range(steps)]
    top = max(1, round(warmup * steps)) - 1
    assert rates[top] == pytest.approx(highest)
    assert all(0 < rate <= highest * (1 + 1e-12) for rate in rates)
    assert rates[: top + 1] == sorted(rates[: top + 1])
    assert rates[top:] == sorted(rates[top:], reverse=True)
    assert rates[-1] >= 0.01 * highest


def stepped(model: Model) -> torch.optim.Optimizer:
    optimiser = make_optimiser(model, 0.1, 0.5)
    for p in model.parameters():
        p.grad = torch.zeros_like(p)
    optimiser.step()
    return optimiser


def test_decay_keeps_matrices_small_and_leaves_the_rest():
    model = build_model("shared", TINY)
    before = {name: p.detach().clone() for name, p in model.named_parameters()}
    stepped(model)
    for name, p in model.named_parameters():
        factor = 1 - 0.1 * 0.5 if p.ndim > 1 else 1.0
        torch.testing.assert_close(p.detach(), factor * before[name])


def test_optimiser_state_is_restored_or_refused():
    model = build_model("shared", TINY)
    optimiser = stepped(model)
    set_rate(optimiser, 0.25)
    assert {group["lr"] for group in optimiser.param_groups} == {0.25}
    tensors = optimiser_tensors(optimiser)
    other = make_optimiser(model, 0.1, 0.5)
    put_optimiser_tensors(other, tensors, "c.ckpt")
    assert equal(optimiser_tensors(other), tensors)
    first = "0.exp_avg"
    bad = [{**tensors, name: torch.zeros(1)} for name in (first, "0.more", "9999.exp_avg", "x")]
    bad.append({name: value for name, value in tensors.items() if name != first})
    for some in bad:
        with pytest.raises(InputError) as error:
            put_optimiser_tensors(other, some, "c.ckpt")
        assert error.value.place == "c.ckpt"

"""The mixture of base positions: the same for every direction of the scene, with probabilities."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.train.models import Model
from datagen.train.models.n2m import _log_chances, _log_rate
from tests.train.models.made_batches import drawn_tables, mirrored, small_model, turned_about_z


@pytest.fixture(scope="module")
def model() -> Model:
    return small_model("n2m")


@settings(max_examples=15, deadline=None)
@given(angle=st.floats(-10, 10), seed=st.integers(0, 50))
@torch.no_grad()
def test_turning_and_mirroring_the_scene_changes_nothing(model: Model, angle: float, seed: int):
    tables = drawn_tables(seed)
    logits = model.score(*tables)
    for same in (turned_about_z(tables, angle), mirrored(tables)):
        torch.testing.assert_close(model.score(*same), logits, atol=1e-3, rtol=1e-3)


@torch.no_grad()
def test_logits_are_logarithms_of_both_probabilities(model: Model):
    logits = model.score(*drawn_tables(0, candidates=50))
    torch.testing.assert_close(logits.exp().sum(1), torch.ones(50))
    log_rate = torch.tensor([-60.0, -12.0, -9.0, -3.0, 0.0, 3.0, 15.0, 40.0], dtype=torch.float64)
    found = _log_chances(log_rate)
    expected = torch.log(-torch.expm1(-torch.exp(log_rate)))
    torch.testing.assert_close(found[:, 1], expected, atol=1e-4, rtol=1e-4)


@torch.no_grad()
def test_a_rate_is_the_mixtures_density_times_its_mass():
    generator = torch.Generator().manual_seed(0)
    mixture = 0.3 * torch.randn((1, 1, 5, 6), generator=generator, dtype=torch.float64)
    side = torch.linspace(-8, 8, 801, dtype=torch.float64)
    at = torch.cartesian_prod(side, side)[:, None]
    rate = _log_rate(mixture.expand(len(at), -1, -1, -1), at).exp()
    # A component of weight w has mass 2 pi exp(w) times the square of the first standard deviation.
    mass = 2 * torch.pi * 0.3**2 * mixture[0, 0, :, 0].exp().sum()
    torch.testing.assert_close(rate.sum() * float(side[1] - side[0]) ** 2, mass, rtol=1e-3, atol=0)

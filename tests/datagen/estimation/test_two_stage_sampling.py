"""The probabilities of a two-stage sample are those that it states."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.estimation.two_stage_sampling import Design, draw_sample, first_of, in_proportion

SCENES, SIZE, N_SCENES, PER_SCENE, SHARE = 12, 8, 5, 3, 0.25


def design_of(name: str, rng: np.random.Generator) -> Design:
    score = rng.random((SCENES, SIZE)) ** 4
    score[0] = 0
    return (
        first_of(score, N_SCENES, PER_SCENE, rng)
        if name == "first"
        else in_proportion(score, N_SCENES, PER_SCENE)
    )


@pytest.mark.parametrize("name", ["first", "in proportion"])
def test_candidates_are_drawn_as_often_as_stated(name: str) -> None:
    rng = np.random.default_rng(0)
    design = design_of(name, rng)
    drawn, stated = np.zeros((SCENES, SIZE)), np.full((SCENES, SIZE), np.nan)
    draws = 4000
    for _ in range(draws):
        sample = draw_sample(design, N_SCENES, PER_SCENE, SHARE, rng)
        at = sample.scene[:, None], sample.candidate
        drawn[at] += 1
        assert (np.isnan(stated[at]) | np.isclose(stated[at], sample.probability)).all()
        stated[at] = sample.probability
        assert sample.candidate.shape == (N_SCENES, PER_SCENE)
        assert (np.diff(sample.scene) > 0).all() and (np.diff(sample.candidate, axis=1) > 0).all()
    assert stated.sum() == pytest.approx(N_SCENES * PER_SCENE)
    assert stated.min() >= SHARE * N_SCENES / SCENES * PER_SCENE / SIZE - 1e-12
    error = np.sqrt(stated * (1 - stated) / draws)
    assert (np.abs(drawn / draws - stated) <= 4.5 * error + 1e-12).all()


def test_the_first_are_the_highest_scores_in_the_scenes_with_the_highest() -> None:
    score = np.arange(SCENES * SIZE, dtype=float).reshape(SCENES, SIZE)
    design = first_of(score, N_SCENES, PER_SCENE, np.random.default_rng(0))
    assert np.flatnonzero(design.scene).tolist() == list(range(SCENES - N_SCENES, SCENES))
    assert (design.candidate[:, -PER_SCENE:] == 1).all() and design.candidate.sum() == SCENES * PER_SCENE


def test_a_proportion_is_never_above_one_and_zeros_fill_up() -> None:
    size = np.array([[100.0, 1, 1, 0], [5, 0, 0, 0]])
    design = in_proportion(size, 1, 2)
    np.testing.assert_allclose(design.candidate, [[1, 0.5, 0.5, 0], [1, 1 / 3, 1 / 3, 1 / 3]])
    assert design.scene.sum() == 1


def test_everything_is_selected_where_nothing_is_left_out() -> None:
    design = in_proportion(np.ones((4, 3)), 4, 3)
    sample = draw_sample(design, 4, 3, 0.2, np.random.default_rng(0))
    assert sample.scene.tolist() == [0, 1, 2, 3] and (sample.probability == 1).all()


def test_the_same_seed_gives_the_same_sample() -> None:
    design = design_of("in proportion", np.random.default_rng(1))
    one, two = (draw_sample(design, N_SCENES, PER_SCENE, SHARE, np.random.default_rng(7)) for _ in range(2))
    np.testing.assert_array_equal(one.candidate, two.candidate)
    np.testing.assert_array_equal(one.probability, two.probability)

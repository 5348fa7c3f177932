"""What each plain method says, how it is fitted, and that it does so on real runs."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.schemas.errors import InputError
from datagen.schemas.specification import PANDA_REACH_M, HeuristicParams
from datagen.train.baselines import BASELINES, FIELDS, Baseline, fit_baselines, make_baselines
from datagen.train.baselines.baseline import (
    Unfitted,
    best_cut,
    calibrate,
    is_feasible,
    mount_m,
    observed_rho,
    planar_distance_m,
    reach_m,
)
from datagen.train.baselines.rules import Analytic, DistanceBand, Proximity, ReachShare, ThresholdVisibility
from datagen.train.baselines.scalars import FAR_M, FEATURES, Scalars, features, observed_clearance_m
from datagen.train.dataset import SampleStream
from datagen.train.inputs import F64, Batch, is_clear
from datagen.workers.labels.distance_visibility_score import heuristic
from tests.sim_extra import SIM_INSTALLED
from tests.train.baselines.scenes import make_batch, moved, take


def balanced(said: np.ndarray, label: np.ndarray) -> float:
    return float(0.5 * (said[label].mean() + (~said)[~label].mean()))


def made() -> list[Baseline]:
    """One of each, with few steps where there is something to learn."""
    names = [name for name in BASELINES if name != "reachability" or SIM_INSTALLED]
    return [replace(b, steps=100) if isinstance(b, Scalars) else b for b in make_baselines(names)]


@pytest.fixture(scope="module")
def fitted() -> list[Baseline]:
    return fit_baselines(made(), [make_batch(seed) for seed in range(3)])


@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 1000))
def test_order_of_candidates_changes_no_score(fitted: list[Baseline], seed: int) -> None:
    batch = make_batch(seed)
    rows = np.random.default_rng(seed).permutation(len(batch))
    for baseline in fitted:
        assert json.loads(json.dumps(baseline.state())) is not None
        shuffled = baseline.score(take(batch, rows))
        np.testing.assert_allclose(shuffled, baseline.score(batch)[rows], atol=0.02, err_msg=baseline.name)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), share=st.floats(0.1, 0.99))
def test_closer_is_better_by_proximity_and_never_infeasible_by_threshold(seed: int, share: float) -> None:
    batch = make_batch(seed)
    closer = moved(batch, batch.candidates.base_xy_m * share)
    assert (Proximity().score(closer) > Proximity().score(batch)).all()
    geometric = BASELINES["threshold"]()
    assert (geometric.score(closer) >= geometric.score(batch)).all()


@given(st.integers(0, 2**32))
@settings(max_examples=20, deadline=None)
def test_reach_share_prefers_clear_bases_at_three_quarters_of_the_reach(seed: int) -> None:
    batch = make_batch(seed % 1000)
    score, clear = ReachShare().score(batch), batch.extra["base_is_clear"].astype(bool)
    share = mount_m(batch) / reach_m(batch)
    if clear.any():
        best = np.flatnonzero(clear)[np.abs(share[clear] - 0.75).argmin()]
        assert score[best] == score.max()
    assert not (score[~clear] >= ReachShare.threshold).any()
    near = clear & (np.abs(share - 0.75) < 0.0999)
    assert (score[near] >= ReachShare.threshold).all()


def test_proximity_picks_the_nearest_clear_one_and_threshold_those_within_reach() -> None:
    batch = make_batch(1)
    geometric = BASELINES["threshold"]()
    said = geometric.score(batch) >= geometric.threshold
    assert np.array_equal(said, is_feasible(batch)) and 0 < said.sum() < len(said)
    score = Proximity().score(batch)
    clear = is_clear(batch)
    best = int(score.argmax())
    assert clear[best] and planar_distance_m(batch)[best] == planar_distance_m(batch)[clear].min()
    assert score[~clear].max() < score[clear].min()
    assert np.isnan(Proximity().threshold)


def test_analytic_is_the_label_sources_rule_on_the_estimated_visibility() -> None:
    batch = make_batch(3)
    params = HeuristicParams(mu=0.6, tau=0.5)
    d = planar_distance_m(batch).astype(np.float32)
    expected = heuristic(d, d, d, observed_rho(batch).astype(np.float32), params)[1]
    everywhere = Analytic(params, only_clear=False)
    assert np.array_equal(everywhere.score(batch) >= everywhere.threshold, expected == 1)
    clear_only = Analytic(params)
    assert np.array_equal(clear_only.score(batch) >= clear_only.threshold, (expected == 1) & is_clear(batch))


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 6), st.booleans()), min_size=2, max_size=30))
def test_best_cut_equals_exhaustive_search(rows: list[tuple[int, bool]]) -> None:
    score, label = np.array([float(s) for s, _ in rows]), np.array([y for _, y in rows])
    if label.all() or not label.any():
        return
    found = balanced(score >= best_cut(score, label), label)
    assert found == pytest.approx(max(balanced(score >= cut, label) for cut in [*score, 99.0]))


def test_distance_finds_the_kind_and_the_band_that_made_the_labels() -> None:
    batches = [make_batch(seed) for seed in range(4)]
    band = DistanceBand().fit(batches)
    assert band.kind == "planar-over-reach" and band.high == pytest.approx(0.8, abs=0.05)
    test = make_batch(50)
    assert balanced(band.score(test) >= band.threshold, test.label == 1) > 0.95


def test_scalars_learn_and_are_the_same_for_the_same_seed() -> None:
    batches = [make_batch(seed, n_scenes=6) for seed in range(4)]
    fitted = Scalars(seed=5, steps=300).fit(batches)
    test = make_batch(50)
    assert balanced(fitted.score(test) >= fitted.threshold, test.label == 1) > 0.9
    # Trained where every base fits, it still rules out where one does not.
    clear_only = [take(b, np.flatnonzero(is_clear(b))) for b in batches]
    assert (Scalars(steps=100).fit(clear_only).score(test)[~is_clear(test)] == 0).all()
    again = Scalars(seed=5, steps=300).fit(batches)
    bare = replace(test, extra={"base_is_clear": test.extra["base_is_clear"]})  # all that a robot knows
    assert np.array_equal(again.score(bare), fitted.score(test))
    assert not np.array_equal(Scalars(seed=6, steps=300).fit(batches).score(test), fitted.score(test))


def test_scalars_have_all_named_features_and_learn_from_the_observed_room() -> None:
    batch = make_batch(3)
    numbers = features(batch)
    assert numbers.shape == (len(batch), len(FEATURES))
    room_m = numbers[:, FEATURES.index("observed_clearance_m")]
    assert np.array_equal(room_m, observed_clearance_m(batch))
    # Labels that follow nothing but the room are learned from it.
    batches = [make_batch(seed, n_scenes=6, points=40) for seed in range(6)]
    rooms_m = [observed_clearance_m(b) for b in batches]
    roomy = [replace(b, label=(r > 0.05).astype(np.int64)) for b, r in zip(batches, rooms_m, strict=True)]
    fitted = Scalars().fit(roomy[1:])
    clear = is_clear(batches[0])
    said = fitted.score(batches[0])[clear] >= fitted.threshold
    assert balanced(said, roomy[0].label[clear] == 1) > 0.9


def test_scalars_leave_out_whole_houses_and_stop_before_they_learn_noise_by_heart() -> None:
    batches = [make_batch(seed, n_scenes=3, per_robot=8) for seed in range(4)]
    rng = np.random.default_rng(0)
    noise = [replace(b, label=rng.integers(0, 2, len(b))) for b in batches]
    fitted = Scalars().fit(noise)
    chance = np.concatenate([fitted.score(b)[is_clear(b)] for b in noise])
    # Nothing can be known, and what is held out says so.
    assert np.abs(chance - 0.5).mean() < 0.15
    with pytest.raises(InputError, match="come from 3 scenes"):
        Scalars().fit(batches[:1])


def test_the_threshold_of_scalars_fits_best_where_few_are_good() -> None:
    batches, rng = [make_batch(seed, n_scenes=6) for seed in range(4)], np.random.default_rng(0)
    rare = [replace(b, label=b.label * (rng.random(len(b)) < 0.3)) for b in batches]
    fitted = Scalars(steps=200).fit(rare)
    score, label, feasible = (
        np.concatenate([of(b) for b in rare]) for of in (fitted.score, lambda b: b.label == 1, is_feasible)
    )
    score, label = score[feasible], label[feasible]
    best = max(balanced(score >= cut, label) for cut in score)
    assert balanced(score >= fitted.threshold, label) == best > balanced(score >= 0.5, label)


def test_the_cut_of_visibility_is_fitted_among_feasible_candidates() -> None:
    batches = [make_batch(seed) for seed in range(2)]
    by_rho = ThresholdVisibility().fit(batches)
    assert by_rho.threshold >= 0
    expected = np.where(is_feasible(batches[0]), observed_rho(batches[0]), -1)
    assert np.array_equal(by_rho.score(batches[0]), expected)


def test_impossible_fits_and_scores_give_one_line() -> None:
    batch = make_batch(0)
    one_class = replace(batch, label=np.zeros_like(batch.label))
    for name in ("distance", "scalars", "threshold-visibility"):
        with pytest.raises(InputError, match="labels are equal"):
            BASELINES[name]().fit([one_class])
    with pytest.raises(InputError, match="labels are equal"):
        calibrate(Given(np.zeros(len(batch))), [one_class])
    with pytest.raises(InputError, match="is not a baseline"):
        make_baselines(["nearest"])
    with pytest.raises(InputError, match="not fitted"):
        Scalars().score(batch)
    with pytest.raises(InputError, match="base_is_clear"):
        Proximity().score(replace(batch, extra={}))


def test_fits_on_a_run_and_scores_it(sim_run: Path) -> None:
    batches = list(SampleStream([sim_run], extra=FIELDS, shuffle=False).epoch(0))
    label = np.concatenate([b.label for b in batches])
    assert 0 < label.sum() < len(label)
    for baseline in fit_baselines(made(), batches):
        score = np.concatenate([baseline.score(b) for b in batches])
        assert score.shape == label.shape and np.isfinite(score).all()
    scalars = Scalars(steps=500).fit(batches)
    said = np.concatenate([scalars.score(b) for b in batches]) >= scalars.threshold
    assert (said == (label == 1)).mean() > 0.9  # more numbers than samples: it can know them by heart


@dataclass(frozen=True, eq=False)
class Given(Unfitted):
    """Scores that are given."""

    scores: F64
    name = "given"
    threshold = 0.0

    def score(self, batch: Batch[Any]) -> F64:
        return self.scores


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 100), levels=st.integers(2, 30))
def test_chances_rise_with_the_score(seed: int, levels: int) -> None:
    batch, rng = make_batch(seed), np.random.default_rng(seed)
    score = 100.0 * rng.integers(0, levels, len(batch))
    label = (rng.uniform(size=len(batch)) < score / (100 * levels)).astype(np.int64)
    clear = is_clear(batch)
    if len(set(label[clear])) < 2:
        return
    chances = calibrate(Given(score), [replace(batch, label=label)])
    at = chances(np.linspace(-1000, 100 * levels + 1000, 300))
    assert (np.diff(at) >= -1e-12).all() and at.min() >= 0 and at.max() <= 1


def test_two_scores_get_the_shares_of_good_ones_among_clear_candidates() -> None:
    batch = make_batch(1)
    clear = is_clear(batch)
    score = np.where(np.arange(len(batch)) % 2 == 0, 7.0, -3.0)
    k = np.arange(len(batch))
    label = np.where(score == 7, k % 3 > 0, k % 5 == 0).astype(np.int64)
    chances = calibrate(Given(score), [replace(batch, label=label)])
    for value in (-3.0, 7.0):
        share = label[clear & (score == value)].mean()
        assert chances(np.array([value]))[0] == pytest.approx(share)


def batch_with(points_m: list[list[float]], base_xy_m: list[list[float]]) -> Batch[Any]:
    """A target 0.8 m above the floor, an arm of 1 m mounted at 0.7 m, and bases."""
    batch = take(make_batch(0, n_scenes=1, per_robot=len(base_xy_m)), np.arange(len(base_xy_m)))
    points = np.array([points_m], np.float32)
    clouds = replace(
        batch.clouds,
        points_m=points,
        rgb=np.zeros(points.shape, np.uint8),
        target_mask=np.zeros(points.shape[:2], np.bool_),
        n_points=np.array([points.shape[1]]),
        target_height_m=np.array([0.8], np.float32),
    )
    mounts, reach = np.full(2, 0.7, np.float32), np.ones(2, np.float32)
    robots = replace(batch.robots, base_height_m=mounts, arm_reach_m=reach)
    return moved(replace(batch, clouds=clouds, robots=robots), np.array(base_xy_m))


def test_room_is_the_distance_to_the_nearest_point_beside_the_base() -> None:
    batch = batch_with([[0, 0, -0.4], [0, 0.3, -0.4]], [[0.6, 0], [0.1, 0], [2.0, 0]])
    room = observed_clearance_m(batch)
    np.testing.assert_allclose(room, [0.35, -0.15, FAR_M], atol=1e-6)
    # Short arms have narrow bases.
    short = replace(batch, robots=replace(batch.robots, arm_reach_m=np.full(2, 0.5, np.float32)))
    more = (observed_clearance_m(short) - room)[:2]
    np.testing.assert_allclose(more, 0.25 * (1 - 0.5 / PANDA_REACH_M), atol=1e-6)
    for height_m in (-0.79, 0.0, np.nan):  # floor, above the mount, not a number
        assert (observed_clearance_m(batch_with([[0, 0, height_m]], [[0.1, 0], [0.5, 0]])) == FAR_M).all()


def test_more_points_leave_less_room() -> None:
    batch = make_batch(3)
    room = observed_clearance_m(batch)
    fewer = replace(batch, clouds=replace(batch.clouds, n_points=batch.clouds.n_points // 2))
    assert (observed_clearance_m(fewer) >= room).all() and (observed_clearance_m(fewer) > room).any()

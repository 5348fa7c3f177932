"""Label sources `plan` and `sim` on a hand-made scene, with the real arm, grasps and physics."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.schemas.errors import InputError
from datagen.schemas.fields import OUTCOMES, RETRY_OUTCOMES, SCHEMAS, facing_rad
from datagen.schemas.identity import Stream, generator
from datagen.schemas.run_records import StageClock
from datagen.schemas.specification import (
    ArmParams,
    CandidateParams,
    DisturbanceParams,
    GraspParams,
    Source,
    Specification,
    TrialParams,
    VisibilityParams,
)
from datagen.workers.bases.candidates import SceneCandidates
from datagen.workers.bases.clearance import base_clearance_m
from datagen.workers.geometry.transforms import pose, translation
from datagen.workers.labels import arm_labelling, arm_sources, load_label_source
from datagen.workers.labels.arm_labelling import arm_in_scene, draw_disturbances, try_candidate
from datagen.workers.labels.arrival_trial import try_arrival
from datagen.workers.motion import MotionPlan
from datagen.workers.run_shard import good_share
from datagen.workers.scenes import SettledScene
from datagen.workers.trials import TrialResult
from datagen.workers.trials.execute import run_trial
from datagen.workers.watched_clock import WatchedClock
from tests.workers.motion.tables import scene_of
from tests.workers.worlds import box_model, on_table, table_house

NAMES = tuple(OUTCOMES)
REACH_M, HEIGHT_M = 0.85, 0.75
# Around the target, metres: in front of the table (three times), on it, behind the wall, far off.
OFFSETS_M = [(0.0, -0.62), (0.15, -0.6), (-0.2, -0.65), (0.0, 0.1), (0.0, 2.4), (1.6, -0.9)]
TARGET = box_model("box", (0.05, 0.05, 0.12))


def specification(**arm: Any) -> Specification:
    return Specification(
        label_source="sim" if "trial" in arm else "plan",
        seed=3,
        houses=Source(kind="builtin", digest="1" * 64),
        objects=Source(kind="builtin", digest="2" * 64),
        candidates=CandidateParams(base_radius_m=0.2),
        visibility=VisibilityParams(window_px=16),
        # A box needs no long search.
        arm=ArmParams(grasps=GraspParams(per_object=24), **arm),
    )


def scene() -> SettledScene:
    clutter = box_model("clutter", (0.06, 0.06, 0.08))
    objects, poses = [TARGET, clutter], [on_table(TARGET, 0.0, -0.2), on_table(clutter, 0.25, 0.1)]
    return scene_of(table_house(), objects, poses)


def candidates(at: SettledScene) -> SceneCandidates:
    n = len(OFFSETS_M)
    xy = (at.target_center_m[:2] + np.array(OFFSETS_M)).astype(np.float32)
    ones = np.ones(n, np.float32)
    camera_m, height_m = ones * np.float32(1.2), ones * np.float32(HEIGHT_M)
    params = CandidateParams(base_radius_m=0.2)
    radius_m = np.full(n, params.base_radius_m)
    clearance = base_clearance_m(xy, height_m, camera_m, radius_m, at.house.obstacles, params.mast_radius_m)
    yaw_rad = facing_rad(at.target_center_m[:2] - xy).astype(np.float32)
    return SceneCandidates(
        xy, yaw_rad, np.zeros(n, np.int16), camera_m, height_m, ones * np.float32(REACH_M), clearance
    )


def label(spec: Specification, at: SettledScene | None = None) -> dict[str, np.ndarray]:
    at = at or scene()
    return load_label_source(spec.label_source).label(at, candidates(at), spec, StageClock())


@pytest.fixture(scope="module")
def labelled() -> dict[str, dict[str, np.ndarray]]:
    return {"plan": label(specification()), "sim": label(specification(trial=TrialParams()))}


def test_each_candidate_has_the_cause_a_person_would_name(labelled: dict[str, Any]) -> None:
    for columns in labelled.values():
        outcome = [NAMES[code] for code in columns["outcome"]]
        assert outcome[:3] == ["success"] * 3
        assert outcome[3:5] == ["base_collision"] * 2  # on the table, and outside the room
        assert outcome[5] in ("out_of_reach", "base_collision")
        np.testing.assert_array_equal(columns["label"], [1, 1, 1, 0, 0, 0])


def test_columns_are_those_of_the_schema(labelled: dict[str, Any]) -> None:
    drawn = {"sample_id", "sample_scene_index", "candidate_index", "robot_index", "base_xy_m", "base_yaw_rad"}
    drawn |= {"camera_height_m", "base_height_m", "arm_reach_m", "base_clearance_m", "base_is_clear"}
    drawn |= {"label_source", "label_version"}
    for name, columns in labelled.items():
        fields = {f.name: f for f in SCHEMAS[name].sample_fields if f.name not in drawn}
        assert set(columns) == set(fields)
        for field in fields.values():
            values = columns[field.name]
            assert values.dtype == np.dtype(field.dtype), field.name
            assert values.shape == SCHEMAS[name].shape(field, len(OFFSETS_M))
            assert np.isfinite(values).all()


def test_positive_rows_have_a_plan(labelled: dict[str, Any]) -> None:
    for name, columns in labelled.items():
        good = columns["label"] == 1
        assert (columns["path_length_rad"][good] > 0.5).all()
        assert (columns["grasps_free"][good] > 0).all() and (columns["grasps_tried"][good] > 0).all()
        assert np.linalg.norm(columns["T_target_tcp"][good][:, :3, 3], axis=1).max() < 0.12
        assert (columns["q_grasp_rad"][~good] == 0).all()
        if name == "sim":
            assert (columns["lift_m"][good] > 0.08).all() and (columns["slip_m"][good] < 0.03).all()
            np.testing.assert_array_equal(columns["trials"], good)
            np.testing.assert_array_equal(columns["successes"], good)


def test_sim_plans_as_plan_does(labelled: dict[str, Any]) -> None:
    for name in ("T_target_tcp", "q_grasp_rad", "path_length_rad", "grasps_free", "heuristic_label"):
        np.testing.assert_array_equal(labelled["plan"][name], labelled["sim"][name])


def test_a_candidate_alone_has_the_label_it_has_among_others(labelled: dict[str, Any]) -> None:
    at, spec = scene(), specification(trial=TrialParams())
    for row in (2, 0):
        arm = arm_in_scene(at, candidates(at), row, spec, StageClock())
        trial = try_candidate(arm, candidates(at), row, spec)
        assert trial.results[-1].slip_m == pytest.approx(labelled["sim"]["slip_m"][row], abs=0)
        assert NAMES[labelled["sim"]["outcome"][row]] == trial.outcome


def test_the_first_grasp_decides_and_later_ones_are_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without friction nothing holds: one candidate, three grasps."""
    at, spec = scene(), specification(trial=TrialParams(object_friction=0.0, max_attempts=3))
    executed: list[int] = []

    def run_and_note(trials: Any, T_world_base: Any, plan: MotionPlan, *rest: Any) -> TrialResult:
        executed.append(plan.grasp)
        return run_trial(trials, T_world_base, plan, *rest)

    monkeypatch.setattr(arm_labelling, "run_trial", run_and_note)
    _, trials = arm_sources.label_with_trials(at, candidates(at), spec, StageClock())
    tried = [trial for trial in trials if trial.results]
    assert len(tried) == 3
    assert all(len(set(executed[k : k + 3])) == 3 for k in (0, 3, 6)) and len(executed) == 9
    for trial in tried:
        assert len(trial.results) == 3
        assert (trial.outcome, trial.retry_outcome) == (trial.results[0].outcome, trial.results[-1].outcome)
    columns = label(spec, at)
    np.testing.assert_array_equal(columns["attempts"], [3, 3, 3, 0, 0, 0])
    np.testing.assert_array_equal(columns["trials"], [1, 1, 1, 0, 0, 0])
    assert not columns["successes"].any() and not columns["label"].any()
    retries = [RETRY_OUTCOMES[code] for code in columns["retry_outcome"]]
    assert retries == [trial.retry_outcome or "none" for trial in trials]
    assert "none" not in retries[:3] and set(retries[3:]) == {"none"}


@pytest.mark.parametrize(
    ("shares", "tried"), [((0.0, 1.0), 6), ((0.6, 0.8), 6), ((0.05, 0.6), 3), ((0.8, 1.0), 6)]
)
def test_labelling_ends_where_the_share_of_good_candidates_is_outside(
    labelled: dict[str, Any], shares: tuple[float, float], tried: int
) -> None:
    """Three of the four candidates that are clear and in reach are good, the first three in order."""
    at, clock = scene(), WatchedClock()
    columns = arm_sources.label_within(at, candidates(at), specification(), clock, shares)
    assert clock.labels == tried
    share = good_share(candidates(at), labelled["plan"])
    assert (columns is not None) == (shares[0] <= share <= shares[1])
    for name, column in (columns or {}).items():
        np.testing.assert_array_equal(column, labelled["plan"][name])


def test_draws_are_counted_and_the_first_is_stored(labelled: dict[str, Any]) -> None:
    at, spec = scene(), specification(draws=3)
    columns, one = label(spec, at), labelled["plan"]
    assert {name for name in columns if not np.array_equal(columns[name], one[name])} == {
        "trials",
        "successes",
    }
    np.testing.assert_array_equal(columns["trials"], 3 * one["trials"])
    found = np.zeros(3, int)
    for draw in range(3):
        arms = [arm_in_scene(at, candidates(at), row, spec, StageClock(), draw) for row in range(3)]
        plans = [try_candidate(arm, candidates(at), row, spec).plan for row, arm in enumerate(arms)]
        found += [plan is not None for plan in plans]
        arrived = [
            try_arrival(arm, candidates(at), row, (0.0, 0.0, 0.0), None, spec) for row, arm in enumerate(arms)
        ]
        assert [outcome == "success" for outcome in arrived] == [plan is not None for plan in plans]
        if draw:
            assert plans[0] is not None and plans[0].length_rad != one["path_length_rad"][0]
    np.testing.assert_array_equal(columns["successes"][:3], found)


def test_repeats_are_counted() -> None:
    wild = DisturbanceParams(repeats=4, target_position_std_m=0.02, base_position_std_m=0.15)
    columns = label(specification(trial=TrialParams(), disturbance=wild))
    planned = columns["path_length_rad"] > 0
    np.testing.assert_array_equal(columns["trials"], np.where(planned, 4, 0))
    assert (columns["successes"] <= columns["attempts"]).all()
    assert (columns["attempts"] <= columns["trials"]).all()
    # Some arrive where the body does not fit or the arm does not reach, some close beside the target.
    assert columns["successes"].sum() < columns["attempts"].sum() < columns["trials"].sum()
    good = 2 * columns["successes"] >= columns["trials"]
    np.testing.assert_array_equal(columns["label"] == 1, planned & good)


def test_plans_from_arrivals_do_not_change_the_label(labelled: dict[str, Any]) -> None:
    wild = DisturbanceParams(repeats=4, base_position_std_m=0.15)
    plan, calm = label(specification(disturbance=wild)), labelled["plan"]
    for name in calm.keys() - {"trials", "successes"}:
        np.testing.assert_array_equal(plan[name], calm[name], err_msg=name)
    np.testing.assert_array_equal(calm["successes"], calm["label"])
    assert (calm["trials"] <= 1).all() and (calm["successes"] <= calm["trials"]).all()
    np.testing.assert_array_equal(plan["trials"], 4 * calm["trials"])
    good = calm["label"] == 1
    assert 0 < plan["successes"][good].sum() < plan["trials"][good].sum()


def test_a_robot_plans_from_where_it_arrives(labelled: dict[str, Any]) -> None:
    near = DisturbanceParams(
        repeats=2, target_position_std_m=0.0, target_yaw_std_rad=0.0, base_position_std_m=0.03
    )
    columns = label(specification(trial=TrialParams(), disturbance=near))
    # Executed blindly, errors of 3 cm at the base would miss most grasps.
    np.testing.assert_array_equal(columns["successes"][:3], [2, 2, 2])
    np.testing.assert_array_equal(columns["q_grasp_rad"][:3], labelled["plan"]["q_grasp_rad"][:3])


def test_a_target_without_grasps_or_inside_another_body_has_outcome_no_grasp() -> None:
    wide, block = box_model("wide", (0.3, 0.3, 0.2)), box_model("block", (0.07, 0.07, 0.14))
    T = on_table(TARGET, 0.0, -0.2)
    within = scene_of(table_house(), [TARGET, block], [T, T @ translation(0, 0, 0.01)])
    for at in (scene_of(table_house(), [wide], [on_table(wide)]), within):
        columns = label(specification(), at)
        assert NAMES[columns["outcome"][0]] == "no_grasp" and not columns["label"].any()


def test_an_arm_needs_its_section() -> None:
    with pytest.raises(InputError, match="arm"):
        label(specification().model_copy(update={"arm": None}))


@given(
    q=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
    position=st.tuples(*[st.floats(-20, 20)] * 3),
    seed=st.integers(0, 2**32),
)
def test_a_disturbed_target_slides_and_turns_on_its_plane_however_it_lies(
    q: tuple[float, ...], position: tuple[float, ...], seed: int
) -> None:
    T = pose(np.array(position), np.array(q))
    params = DisturbanceParams(repeats=3)
    for disturbance in draw_disturbances(params, T, generator(seed, Stream.DISTURBANCE, 0)):
        moved = T @ disturbance.T_target_moved
        turn = moved[:3, :3] @ T[:3, :3].T
        np.testing.assert_allclose(turn[2], [0, 0, 1], atol=1e-9)
        np.testing.assert_allclose(turn[:, 2], [0, 0, 1], atol=1e-9)
        assert abs(moved[2, 3] - T[2, 3]) < 1e-9
        assert disturbance.T_base_moved[2, 3] == 0
        assert params.object_friction.low <= disturbance.object_friction <= params.object_friction.high
        assert params.mass_scale.low <= disturbance.mass_scale <= params.mass_scale.high


def test_disturbances_have_the_asked_spread() -> None:
    params = DisturbanceParams(repeats=1000, target_position_std_m=0.01, base_yaw_std_rad=0.02)
    drawn = draw_disturbances(params, np.eye(4), generator(0, Stream.DISTURBANCE, 0))
    x = np.array([d.T_target_moved[0, 3] for d in drawn])
    yaw = np.array([np.arctan2(d.T_base_moved[1, 0], d.T_base_moved[0, 0]) for d in drawn])
    np.testing.assert_allclose([x.std(), yaw.std()], [0.01, 0.02], rtol=0.1)
    assert abs(x.mean()) < 0.002


def test_fewer_repeats_are_the_first_of_more() -> None:
    few, many = (
        draw_disturbances(DisturbanceParams(repeats=k), np.eye(4), generator(3, Stream.DISTURBANCE, 1))
        for k in (2, 5)
    )
    for a, b in zip(few, many, strict=False):
        np.testing.assert_array_equal(a.T_target_moved, b.T_target_moved)
        assert a.object_friction == b.object_friction


def test_a_watched_clock_counts_each_label_and_changes_none(labelled: dict[str, Any]) -> None:
    at, clock, seen = scene(), WatchedClock(), list[tuple[str, int]]()
    clock.watch = lambda stage, labels: seen.append((stage, labels))
    columns = load_label_source("plan").label(at, candidates(at), specification(), clock)
    assert clock.labels == len(OFFSETS_M)
    assert seen[0][1] == 0 and seen[-1][1] > 0 and {"grasps", "plan"} <= {stage for stage, _ in seen}
    assert [labels for _, labels in seen] == sorted(labels for _, labels in seen)
    for name, values in labelled["plan"].items():
        np.testing.assert_array_equal(columns[name], values, err_msg=name)

"""Successes in real scenes, looked at again by geometry alone: recorded poses, half-spaces and numpy.

Nothing here asks the planner's collision checks or the physics: convex parts are cut into half-spaces and
points, objects are the unmerged ones, and what is measured is measured on the recorded poses.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("sapien", reason="SAPIEN cannot be imported here: run `datagen doctor`")

from datagen.configuration.specify import specify
from datagen.schemas.run_records import StageClock
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import inverse, translation
from datagen.workers.houses import open_houses
from datagen.workers.labels.arm_labelling import ArmInScene, arm_in_scene, try_candidate
from datagen.workers.motion import MotionPlan
from datagen.workers.motion.planning_scene import pose_of_base
from datagen.workers.objects import open_objects
from datagen.workers.scenes.generate import generate_scene
from datagen.workers.trials import Recording, TrialResult
from datagen.workers.world import assemble_world
from tests.workers.motion.tables import HalfSpaces

pytestmark = pytest.mark.slow

SCENES, SUCCESSES = 12, 3
# PhysX lets bodies enter one another a little before it pushes them apart.
ENTERS_M = 0.005
RNG = np.random.default_rng(0)


@dataclass(frozen=True, eq=False)
class Seen:
    """An executed success and where it stood."""

    at: ArmInScene
    T_world_base: F64
    plan: MotionPlan
    result: TrialResult
    recording: Recording

    @cached_property
    def T_world_tcp(self) -> F64:
        """(T, 4, 4)."""
        return np.stack([self.T_world_base @ self.at.robot.T_base_tcp(q) for q in self.recording.q_rad])

    def last(self, phase: str) -> int:
        """The last moment of a phase."""
        return max(k for k, name in enumerate(self.recording.phase) if name == phase)


@pytest.fixture(scope="module")
def seen(assets: Path, real_objects: str) -> list[Seen]:
    return successes(f"procthor:{assets / 'procthor'}", real_objects)


def successes(house_source: str, object_source: str) -> list[Seen]:
    """The first success of each of a few scenes."""
    houses, objects = open_houses(house_source), open_objects(object_source)
    chosen = {
        "seed": 3,
        "candidates.per_scene": 12,
        "candidates.robots_per_scene": 1,
        "candidates.within": "in-range",
    }
    spec = specify("sim", houses, objects, chosen, None)
    world = assemble_world(spec, houses, objects, house_source, object_source)
    found: list[Seen] = []
    for index in range(SCENES):
        scene, candidates = generate_scene(world, index, StageClock())
        at = arm_in_scene(scene, candidates, 0, spec, StageClock())
        for row in range(len(candidates)):
            trial = try_candidate(at, candidates, row, spec, record=True)
            if trial.outcome == "success":
                assert trial.plan is not None
                recording = trial.results[-1].recording
                assert recording is not None
                xy = candidates.base_xy_m[row].astype(np.float64)
                T = pose_of_base(xy, at.robot.base_height_m, scene.target_center_m)
                found.append(Seen(at, T, trial.plan, trial.results[-1], recording))
                break
        if len(found) == SUCCESSES:
            break
    assert len(found) == SUCCESSES
    return found


def test_the_arm_goes_through_nothing(seen: list[Seen]) -> None:
    for case in seen:
        assert deepest_m(case) < ENTERS_M


def test_an_arm_that_stood_lower_would_be_seen_to_go_through_something(seen: list[Seen]) -> None:
    lowered = replace(seen[0], T_world_base=translation(0.0, 0.0, -0.1) @ seen[0].T_world_base)
    assert deepest_m(lowered) > 2 * ENTERS_M


def test_the_arm_does_not_go_through_itself(seen: list[Seen]) -> None:
    for case in seen:
        robot = case.at.robot
        shapes = [HalfSpaces(parts, RNG) if parts else None for parts in robot.link_parts_m]
        for q in case.recording.q_rad[::8]:
            T = robot.T_base_link(q)
            for a, b in robot.self_pairs:
                first, second = shapes[a], shapes[b]
                if first is not None and second is not None:
                    assert first.deepest_m(T[a], second, T[b]) < ENTERS_M


def test_joints_keep_to_their_limits_and_speeds(seen: list[Seen]) -> None:
    for case in seen:
        robot, q = case.at.robot, case.recording.q_rad
        assert (q >= robot.q_lower_rad - 0.01).all() and (q <= robot.q_upper_rad + 0.01).all()
        speed_radps = np.abs(np.diff(q, axis=0)) / np.diff(case.recording.time_s)[:, None]
        assert (speed_radps <= robot.speed_limit_radps).all()


def test_the_target_rises_with_the_hand_and_ends_above_where_it_lay(seen: list[Seen]) -> None:
    for case in seen:
        lift_m = case.at.arm.motion.lift_m
        start, closed, end = 0, case.last("close"), case.last("hold")
        corners_m = np.concatenate(case.at.scene.models[0].convex_parts_m).astype(np.float64)
        T = case.recording.T_world_object[:, 0]
        lowest_m = [float((corners_m @ T[k, 2, :3] + T[k, 2, 3]).min()) for k in (start, end)]
        middle_m = corners_m.mean(axis=0)
        rise_m = float((T[end] - T[start])[2, :3] @ middle_m + (T[end] - T[start])[2, 3])
        assert 0.8 * lift_m < rise_m < 1.2 * lift_m
        assert lowest_m[1] > lowest_m[0] + 0.02  # a long thing may hang, but off its support
        hand_m = case.T_world_tcp[end, 2, 3] - case.T_world_tcp[closed, 2, 3]
        assert hand_m == pytest.approx(lift_m, abs=0.01)
        held = [inverse(case.T_world_tcp[k]) @ T[k] for k in range(closed, end + 1)]
        between_pads_m = inverse(held[0])[:3, 3]
        drift_m = [np.linalg.norm(M[:3, :3] @ between_pads_m + M[:3, 3]) for M in held]
        assert max(drift_m) < 0.03
        assert drift_m[-1] == pytest.approx(case.result.slip_m, abs=1e-3)


def test_the_target_is_between_the_pads_at_the_end(seen: list[Seen]) -> None:
    for case in seen:
        end = case.last("hold")
        opening_m = float(case.recording.opening_m[end])
        pad_x_m, pad_z_m = case.at.robot.gripper.pad_size_m
        T_tcp_target = inverse(case.T_world_tcp[end]) @ case.recording.T_world_object[end, 0]
        # Points of the box between the pads, in the target's frame.
        box = RNG.uniform(-0.5, 0.5, (4000, 3)) * [pad_x_m, opening_m, pad_z_m]
        T = inverse(T_tcp_target)
        points_m = box @ T[:3, :3].T + T[:3, 3]
        target = HalfSpaces(case.at.scene.models[0].convex_parts_m, RNG)
        inside = np.zeros(len(points_m), np.bool_)
        for faces in target.faces:
            inside |= (points_m @ faces[:, :3].T + faces[:, 3] <= 0).all(axis=1)
        assert inside.mean() > 0.02
        # The fingers have closed onto it: it reaches from one pad to the other.
        assert np.ptp(box[inside, 1]) > 0.8 * opening_m


def deepest_m(case: Seen) -> float:
    """How deep any part of the arm or hand was in the house or in clutter; the target is the hand's."""
    robot, scene = case.at.robot, case.at.scene
    house = [Solid(part) for body in scene.house.house.bodies for part in body.convex_parts_m]
    clutter = [[Solid(part) for part in model.convex_parts_m] for model in scene.models[1:]]
    hand = {k for k, name in enumerate(robot.link_names) if "hand" in name or "finger" in name}
    links = [(k, part) for k, parts in enumerate(robot.link_parts_m) if k not in hand for part in parts]
    deepest = -np.inf
    for moment in range(0, len(case.recording.time_s), 4):
        T_links = case.T_world_base @ robot.T_base_link(case.recording.q_rad[moment])
        opening_m = float(case.recording.opening_m[moment])
        shapes = [Solid(moved(part, T_links[k])) for k, part in links]
        shapes += [Solid(moved(p, case.T_world_tcp[moment])) for p in robot.gripper.parts_at(opening_m)]
        poses = case.recording.T_world_object[moment, 1:]
        for shape in shapes:
            deepest = max(deepest, shape.deepest_in_m(house))
            for parts, T in zip(clutter, poses, strict=True):
                deepest = max(deepest, shape.deepest_in_m(Solid(moved(p.corners_m, T)) for p in parts))
    return deepest


def moved(part: np.ndarray, T: F64) -> F64:
    return part.astype(np.float64) @ T[:3, :3].T + T[:3, 3]


class Solid:
    """A convex part in the world."""

    def __init__(self, corners_m: np.ndarray) -> None:
        self.corners_m = corners_m.astype(np.float64)
        self.low, self.high = self.corners_m.min(axis=0), self.corners_m.max(axis=0)

    @cached_property
    def half_spaces(self) -> HalfSpaces:
        return HalfSpaces([self.corners_m], RNG)

    def deepest_in_m(self, others: Iterable[Solid]) -> float:
        """How deep a point of either lies in the other; negative or -inf where they are apart."""
        near = [o for o in others if (o.low <= self.high).all() and (o.high >= self.low).all()]
        eye = np.eye(4)
        return max((self.half_spaces.deepest_m(eye, o.half_spaces, eye) for o in near), default=-np.inf)

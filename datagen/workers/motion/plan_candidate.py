"""Plan from one base pose: inverse kinematics, path, approach and lift, or the cause of failure."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import inverse
from datagen.workers.motion import MotionPlan, PlanReport
from datagen.workers.motion.arm_collision import Surroundings, surroundings
from datagen.workers.motion.collision import Ints
from datagen.workers.motion.grasp_filter import backed, line_offsets_m, raised
from datagen.workers.motion.grasp_goals import Goal, goals_of
from datagen.workers.motion.nearby_poses import NearbyPoses, scene_with_poses
from datagen.workers.motion.planning_scene import PlanningScene
from datagen.workers.motion.rrt_connect import connect, dense, is_line_free, shortened, straight

# The order of checks of a grasp, cheap ones first: a path is searched only for grasps with approach and
# lift. A later cause of failure means more progress.
STAGES = ("no_ik", "arm_collision", "no_start", "no_approach", "no_lift", "no_path", "success")
_STARTS = 3  # tucked poses from which a straight line is tried
_SEARCHES = 4  # grasps for which a path is searched where no straight path is free
_SHORTCUTS = 20
_CLEARANCE_POSES = 8
# Poses in one round of the search near grasps, and the largest number of grasps that they are near.
_NEARBY_POSES, _NEARBY_ORIGINS = 1200, 40
_NEARBY_TRIED = 60  # poses of a round for which IK is tried
_SAME_RAD = 0.05  # solutions of one grasp that differ by less count as one


@dataclass(eq=False)
class _Base:
    """A base pose in a scene."""

    scene: PlanningScene
    T_world_base: F64

    @cached_property
    def T_base_world(self) -> F64:
        return inverse(self.T_world_base)

    @cached_property
    def at(self) -> Surroundings:
        return surroundings(self.scene, self.T_world_base)


@dataclass(eq=False)
class _Search:
    """State of the search among some grasps for one candidate, shared by these grasps."""

    scene: PlanningScene
    base: _Base
    far: list[_Reachable] = field(default_factory=list)  # without a free straight path
    furthest: str = "no_ik"
    stages: dict[int, int] = field(default_factory=dict)  # the stage each grasp reached, in this order

    @property
    def at(self) -> Surroundings:
        return self.base.at

    def reached(self, stage: str, *grasps: int) -> None:
        """Record a stage that some grasps reached, if it is the furthest so far."""
        rank = STAGES.index(stage)
        self.furthest = STAGES[max(STAGES.index(self.furthest), rank)]
        for k in grasps:
            self.stages[k] = max(self.stages.get(k, 0), rank)

    def best(self, count: int) -> list[int]:
        """At most `count` of the grasps tried, those that came furthest first."""
        return sorted(self.stages, key=lambda k: -self.stages[k])[:count]

    def holds(self, k: int) -> bool:
        """Whether the hand holds the object in kept grasp `k`; simulated on first use."""
        return self.scene.around.grasps.holds(int(self.scene.around.grasp[k]))


@dataclass(frozen=True, eq=False)
class _Way:
    """Joints at a grasp and at its pregrasp."""

    goal: Goal
    q_grasp: F64  # (A,)
    q_pregrasp: F64  # (A,)


@dataclass(frozen=True, eq=False)
class _Reachable:
    """A grasp with all of a plan except the path to its pregrasp."""

    k: int
    q_approach_rad: F64  # (K, A)
    q_lift_rad: F64  # (J, A)
    homes: Ints  # free ones, nearest first


def plan_candidate(
    prepared: PlanningScene, T_world_base: F64, rng: np.random.Generator, skip: frozenset[int] = frozenset()
) -> PlanReport:
    """Search for a whole plan from the base pose (4, 4) to any grasp except those in `skip`.

    `skip` are rows of the GraspSet. The result depends on the arguments alone: neither on earlier candidates
    nor on time. `rng` is used only where no grasp has a straight path. With `nearby_rounds`, poses near the
    grasps that came furthest follow; `grasp` of such a plan is -1.
    """
    around = prepared.around
    kept, rest = (rows[~np.isin(around.grasp[rows], sorted(skip))] for rows in (around.kept, around.rest))
    if around.grasps_free == 0 or len(kept) + len(rest) == 0:
        return PlanReport("no_grasp", None, around.grasps_free, 0)
    search = _Search(prepared, _Base(prepared, T_world_base))
    plan = _search_grasps(search, kept, rest, prepared.params.max_grasps_tried, rng)
    tried = len(np.unique(around.grasp[list(search.stages)]))
    if plan is None and prepared.params.nearby_rounds:
        plan, more = _search_nearby(search, rng)
        tried += more
    outcome = search.furthest if plan is None else "success"
    return PlanReport(outcome, plan, around.grasps_free, tried)


def _search_grasps(
    search: _Search, kept: Ints, rest: Ints, most: int, rng: np.random.Generator
) -> MotionPlan | None:
    """Search for a plan to at most `most` of the free poses `kept` and `rest`."""
    for goals in goals_of(search.scene, search.base.T_base_world, kept, rest, most):
        search.reached("no_ik", *(goal.k for goal in goals))
        plan = _try_goals(search, goals)
        if plan is not None or search.furthest == "no_start":
            return plan
    return _search_paths(search, rng)


def _search_nearby(first: _Search, rng: np.random.Generator) -> tuple[MotionPlan | None, int]:
    """Search near the grasps that came furthest, then near the best poses found; also the number tried."""
    scene, tried, search = first.scene, 0, first
    near = NearbyPoses.of_grasps(scene.around.T_world_tcp, scene.around.opening_m)
    origins = first.best(_NEARBY_ORIGINS) or scene.around.kept[:_NEARBY_ORIGINS].tolist()
    for _ in range(scene.params.nearby_rounds or 0):
        if not origins or search.furthest == "no_start" or search.at.is_base_stuck:
            break
        near = near.rows(np.array(origins)).varied(_NEARBY_POSES // len(origins), rng)
        around = scene_with_poses(scene.around, near.T_world_tcp(), near.opening_m, scene.params)
        search = _Search(replace(scene, around=around), first.base)
        plan = _search_grasps(search, around.kept, around.rest, _NEARBY_TRIED, rng)
        first.reached(search.furthest)
        tried += len(search.stages)
        if plan is not None:
            return replace(plan, grasp=-1), tried
        if search.furthest == "arm_collision":  # further rounds hardly ever lead out of a collision
            break
        origins = search.best(_NEARBY_ORIGINS)
    return None, tried


def _try_goals(search: _Search, goals: list[Goal]) -> MotionPlan | None:
    """Search for a plan to some grasps: collisions are checked together, all else one by one.

    Grasps that cannot get further than earlier ones are left out.
    """
    so_far = STAGES.index(search.furthest)
    goals = [goal for goal in goals if STAGES.index(goal.limit) > so_far]
    ways = [way for goal in goals for way in _ways(search.scene, goal)]
    if not ways:
        return None
    search.reached("arm_collision", *(way.goal.k for way in ways))
    at = search.at
    if at.is_base_stuck:
        return None
    openings_m = search.scene.around.opening_m[[way.goal.k for way in ways]]
    free = np.flatnonzero(~at.blocked(np.array([way.q_pregrasp for way in ways]), openings_m))
    free = free[~at.blocked(np.array([ways[k].q_grasp for k in free]), None)] if len(free) else free
    for k in free.tolist():
        if len(at.free_homes) == 0:
            search.reached("no_start")
            return None
        plan = _try_way(search, ways[k])
        if plan is not None:
            return plan
    return None


def _ways(scene: PlanningScene, goal: Goal) -> list[_Way]:
    """Joints at a grasp and its pregrasp, at most one for each seed."""
    robot = scene.robot
    T_pregrasp = backed(goal.T_base_tcp, scene.params.pregrasp_m)
    ways: list[_Way] = []
    for seed in goal.seeds_rad:
        q_grasp = robot.ik(goal.T_base_tcp, seed)
        if q_grasp is None or any(np.abs(q_grasp - way.q_grasp).max() < _SAME_RAD for way in ways):
            continue
        q_pregrasp = robot.ik(T_pregrasp, q_grasp)
        if q_pregrasp is not None:
            ways.append(_Way(goal, q_grasp, q_pregrasp))
    return ways


def _try_way(search: _Search, way: _Way) -> MotionPlan | None:
    """Plan approach, lift and a straight path from joints that are free at a grasp and its pregrasp."""
    at, scene = search.at, search.scene
    params, robot = scene.params, scene.robot
    k, T_base_tcp = way.goal.k, way.goal.T_base_tcp
    T_up = np.stack(
        [
            search.base.T_base_world @ raised(scene.around.T_world_tcp[k], float(r))
            for r in line_offsets_m(params.lift_m)
        ]
    )
    search.reached("no_approach", k)
    T_back = np.stack([backed(T_base_tcp, float(b)) for b in line_offsets_m(params.pregrasp_m)])
    # The end of the lift is checked first: where the arm is too short for it, the lines cost most.
    if way.goal.limit == "no_lift" or robot.ik(T_up[-1], way.q_grasp) is None:
        search.reached("no_lift", k)
        return None
    back = follow_line(at, T_back, way.q_grasp, way.q_pregrasp, is_target_held=False)
    if back is None:
        return None
    search.reached("no_lift", k)
    lift = follow_line(at, T_up, way.q_grasp, None, is_target_held=True)
    if lift is None:
        return None
    search.reached("no_path", k)
    homes, opening_m = at.free_homes, float(scene.around.opening_m[k])
    gaps = np.linalg.norm(robot.homes_rad[homes] - way.q_pregrasp, axis=1)
    found = _Reachable(k, back[::-1], lift, homes[np.argsort(gaps, kind="stable")])
    step_rad, first_blocked = params.check_step_rad, partial(at.first_blocked, opening_m=opening_m)
    for home in found.homes[:_STARTS].tolist():
        if is_line_free(robot.homes_rad[home], way.q_pregrasp, first_blocked, step_rad):
            if not search.holds(k):
                return None
            path = straight(robot.homes_rad[home], way.q_pregrasp, step_rad)
            return _plan(search, found, home, path)
    search.far.append(found)
    return None


def _search_paths(search: _Search, rng: np.random.Generator) -> MotionPlan | None:
    """Run RRT-Connect to the first grasps without a straight path; they share the iterations evenly."""
    scene = search.scene
    robot, params = scene.robot, scene.params
    left, far = params.path_iterations, search.far[:_SEARCHES]
    for rank, found in enumerate(far):
        home = int(found.homes[0])
        first_blocked = partial(search.at.first_blocked, opening_m=float(scene.around.opening_m[found.k]))
        corners, used = connect(
            robot.homes_rad[home],
            found.q_approach_rad[0],
            np.maximum(robot.q_lower_rad, -np.pi),
            np.minimum(robot.q_upper_rad, np.pi),
            first_blocked,
            params.check_step_rad,
            left // (len(far) - rank),
            rng,
        )
        left -= used
        if corners is not None and search.holds(found.k):
            path = dense(corners, params.check_step_rad)
            path = shortened(path, first_blocked, params.check_step_rad, _SHORTCUTS, rng)
            return _plan(search, found, home, path)
    return None


def _plan(search: _Search, found: _Reachable, home: int, q_reach: F64) -> MotionPlan:
    scene = search.scene
    opening_m = float(scene.around.opening_m[found.k])
    ways = (q_reach, found.q_approach_rad)
    length = sum(float(np.linalg.norm(np.diff(q, axis=0), axis=1).sum()) for q in ways)
    some = np.linspace(0, len(q_reach) - 1, _CLEARANCE_POSES).round().astype(np.int64)
    clearance_m = search.at.clearance_m(q_reach[some], opening_m)
    grasp = int(scene.around.grasp[found.k])
    score = scene.around.grasps.score_of(grasp)
    return MotionPlan(
        grasp, home, q_reach, found.q_approach_rad, found.q_lift_rad, opening_m, length, clearance_m, score
    )


_OFF_LINE_M = 0.002  # between neighbouring points, where joints are interpolated


def follow_line(
    at: Surroundings, T_base_tcp: F64, q_first: F64, q_last: F64 | None, is_target_held: bool
) -> F64 | None:
    """Joints (K, A) at the hand's poses (K, 4, 4), which lie on a straight line and begin at `q_first`.

    `q_last`, where the end is known, is its joint vector. None where a pose has no solution, a joint
    jumps, the hand leaves the line by more than 2 mm in between, or the arm collides.
    """
    scene = at.scene
    q = [q_first]
    last = len(T_base_tcp) - 1
    for k in range(1, last + 1):
        if k == last and q_last is not None:
            found = q_last
        else:
            # The seed: a step towards the known end, or the last step again.
            step = (q_last - q[-1]) / (last - k + 1) if q_last is not None else q[-1] - q[max(k - 2, 0)]
            found = scene.robot.ik(T_base_tcp[k], q[-1] + step)
        if found is None or np.abs(found - q[-1]).max() > scene.params.max_joint_jump_rad:
            return None
        q.append(found)
    rows = np.array(q)
    between = scene.moving.kinematics.tcp((rows[1:] + rows[:-1]) / 2)[:, :3, 3]
    middle = (T_base_tcp[1:, :3, 3] + T_base_tcp[:-1, :3, 3]) / 2
    if last and np.linalg.norm(between - middle, axis=1).max() > _OFF_LINE_M:
        return None
    path = dense(rows, scene.params.check_step_rad)
    return rows if at.first_arm_blocked(path, is_target_held) == len(path) else None

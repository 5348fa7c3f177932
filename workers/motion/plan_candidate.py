"""Plan from one base pose: inverse kinematics, path, approach and lift, or the cause of failure."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import inverse
from datagen.workers.motion.arm_collision import Surroundings, surroundings
from datagen.workers.motion.cartesian_path import follow_line
from datagen.workers.motion.collision import Ints
from datagen.workers.motion.grasp_filter import backed, line_offsets_m, raised
from datagen.workers.motion.motion_plan import MotionPlan, PlanReport
from datagen.workers.motion.planning_scene import PlanningScene
from datagen.workers.motion.reach_table import order_by_distance
from datagen.workers.motion.rrt_connect import connect, dense, is_line_free, shortened, straight

# The order of checks of a grasp, cheap ones first: a path is searched only for grasps with approach and
# lift. A later cause came further.
STAGES = ("no_ik", "arm_collision", "no_start", "no_approach", "no_lift", "no_path", "success")
_STARTS = 3  # tucked poses from which a straight line is tried
_SEARCHES = 4  # grasps for which a path is searched where none is straight
_SHORTCUTS = 20
_CLEARANCE_POSES = 8
_SAME_RAD = 0.05  # joints of one grasp that differ by less are one way to take it


@dataclass(eq=False)
class _Search:
    """What the grasps of one candidate share."""

    at: Surroundings
    T_base_world: F64
    far: list[_Reachable]  # to which no straight path leads


@dataclass(frozen=True, eq=False)
class _Reachable:
    """A grasp with all of a plan but the path to its pregrasp."""

    k: int
    q_approach_rad: F64  # (K, A)
    q_lift_rad: F64  # (J, A)
    homes: Ints  # free ones, nearest first


def plan_candidate(
    prepared: PlanningScene, T_world_base: F64, rng: np.random.Generator, skip: frozenset[int] = frozenset()
) -> PlanReport:
    """Look for a whole plan from the base pose (4, 4) to any kept grasp but those in `skip`.

    `skip` are rows of the GraspSet. Depends on the arguments alone: neither on candidates before nor on
    time. `rng` is drawn from only where no grasp has a straight path.
    """
    rows = np.flatnonzero(~np.isin(prepared.grasp, sorted(skip)))
    if len(rows) == 0:
        return PlanReport("no_grasp", None, prepared.grasps_free, 0)
    T_base_world = inverse(T_world_base)
    T_base_tcp = np.matmul(T_base_world, prepared.T_world_tcp[rows])
    distance, seeds = prepared.moving.table.nearest(T_base_tcp, prepared.params.ik_seeds)
    order = order_by_distance(distance)[: prepared.params.max_grasps_tried]
    if len(order) == 0:
        return PlanReport("no_ik", None, prepared.grasps_free, 0)
    at = surroundings(prepared, T_world_base)
    search = _Search(at, T_base_world, [])
    tried: set[int] = set()
    furthest = 0
    for k in order.tolist():
        tried.add(int(prepared.grasp[rows[k]]))
        outcome, plan = _try_grasp(search, int(rows[k]), T_base_tcp[k], seeds[k])
        furthest = max(furthest, STAGES.index(outcome))
        if plan is not None or outcome == "no_start":
            return PlanReport(outcome, plan, prepared.grasps_free, len(tried))
    plan = _search_paths(search, rng)
    if plan is not None:
        return PlanReport("success", plan, prepared.grasps_free, len(tried))
    return PlanReport(STAGES[furthest], None, prepared.grasps_free, len(tried))


def _try_grasp(search: _Search, k: int, T_base_tcp: F64, seeds_rad: F64) -> tuple[str, MotionPlan | None]:
    """The arm's ways to take one grasp, one a seed, until one leads to a whole plan."""
    scene, furthest = search.at.scene, "no_ik"
    params = scene.params
    T_back = np.stack([backed(T_base_tcp, float(b)) for b in line_offsets_m(params.pregrasp_m)])
    T_up = np.stack(
        [search.T_base_world @ raised(scene.T_world_tcp[k], float(r)) for r in line_offsets_m(params.lift_m)]
    )
    seen: list[F64] = []
    for seed in seeds_rad:
        q_grasp = scene.robot.ik(T_base_tcp, seed)
        if q_grasp is None or any(np.abs(q_grasp - q).max() < _SAME_RAD for q in seen):
            continue
        seen.append(q_grasp)
        outcome, plan = _try_arm(search, k, q_grasp, T_back, T_up)
        furthest = max(furthest, outcome, key=STAGES.index)
        if plan is not None or outcome == "no_start":
            return outcome, plan
    return furthest, None


def _try_arm(search: _Search, k: int, q_grasp: F64, T_back: F64, T_up: F64) -> tuple[str, MotionPlan | None]:
    """On from joints at grasp `k`; `T_back` and `T_up` (K, 4, 4) are the hand's lines away from it."""
    at, scene = search.at, search.at.scene
    q_pregrasp = scene.robot.ik(T_back[-1], q_grasp)
    if q_pregrasp is None:
        return "no_ik", None
    opening_m = float(scene.opening_m[k])
    if (
        at.is_base_stuck
        or at.first_arm_blocked(q_grasp[None], is_target_held=False) == 0
        or at.first_blocked(q_pregrasp[None], opening_m) == 0
    ):
        return "arm_collision", None
    homes = np.flatnonzero(at.free_homes(opening_m))
    if len(homes) == 0:
        return "no_start", None
    back = follow_line(at, T_back, q_grasp, q_pregrasp, is_target_held=False)
    if back is None:
        return "no_approach", None
    lift = follow_line(at, T_up, q_grasp, None, is_target_held=True)
    if lift is None:
        return "no_lift", None
    gaps = np.linalg.norm(scene.robot.homes_rad[homes] - q_pregrasp, axis=1)
    found = _Reachable(k, back[::-1], lift, homes[np.argsort(gaps, kind="stable")])
    step_rad, first_blocked = scene.params.check_step_rad, partial(at.first_blocked, opening_m=opening_m)
    for home in found.homes[:_STARTS].tolist():
        if is_line_free(scene.robot.homes_rad[home], q_pregrasp, first_blocked, step_rad):
            path = straight(scene.robot.homes_rad[home], q_pregrasp, step_rad)
            return "success", _plan(search, found, home, path)
    search.far.append(found)
    return "no_path", None


def _search_paths(search: _Search, rng: np.random.Generator) -> MotionPlan | None:
    """RRT-Connect to the first grasps that no straight path leads to; they share the iterations evenly."""
    scene = search.at.scene
    robot, params = scene.robot, scene.params
    left, far = params.path_iterations, search.far[:_SEARCHES]
    for rank, found in enumerate(far):
        home = int(found.homes[0])
        first_blocked = partial(search.at.first_blocked, opening_m=float(scene.opening_m[found.k]))
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
        if corners is not None:
            path = dense(corners, params.check_step_rad)
            path = shortened(path, first_blocked, params.check_step_rad, _SHORTCUTS, rng)
            return _plan(search, found, home, path)
    return None


def _plan(search: _Search, found: _Reachable, home: int, q_reach: F64) -> MotionPlan:
    scene = search.at.scene
    opening_m = float(scene.opening_m[found.k])
    ways = (q_reach, found.q_approach_rad)
    length = sum(float(np.linalg.norm(np.diff(q, axis=0), axis=1).sum()) for q in ways)
    some = np.linspace(0, len(q_reach) - 1, _CLEARANCE_POSES).round().astype(np.int64)
    clearance_m = search.at.clearance_m(q_reach[some], opening_m)
    grasp = int(scene.grasp[found.k])
    return MotionPlan(
        grasp, home, q_reach, found.q_approach_rad, found.q_lift_rad, opening_m, length, clearance_m
    )

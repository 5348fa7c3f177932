"""One base pose: from inverse kinematics to a whole plan, or the cause of the try that came furthest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from workers.geometry.mesh import F64
from workers.geometry.transforms import inverse
from workers.motion.hand import backed, line_offsets_m, raised
from workers.motion.lines import follow_line
from workers.motion.plan import MotionPlan, PlanReport
from workers.motion.reach_table import order_by_distance
from workers.motion.rrt_connect import connect, dense, is_line_free, shortened, straight
from workers.motion.scene import PlanningScene
from workers.motion.surroundings import Surroundings, surroundings

# The order in which a grasp is looked at, cheap questions first: a path is searched only to grasps
# from which the rest is known to work. A later cause came further.
STAGES = ("no_ik", "arm_collision", "no_start", "no_approach", "no_lift", "no_path", "success")
_STARTS = 3  # tucked poses from which a straight line is tried
_SHORTCUTS = 20
_CLEARANCE_POSES = 8
_SAME_RAD = 0.05  # joints of one grasp that differ by less are one way to take it


@dataclass(eq=False)
class _Search:
    """What the grasps of one candidate share."""

    at: Surroundings
    T_base_world: F64
    rng: np.random.Generator
    iterations_left: int


def plan_candidate(
    prepared: PlanningScene,
    T_world_base: F64,
    rng: np.random.Generator,
    skip: frozenset[int] = frozenset(),
) -> PlanReport:
    """Look for a whole plan from the base pose (4, 4) to any kept grasp but those in `skip`.

    `skip` are rows of the GraspSet. Depends on the arguments alone: neither on candidates before nor on
    time. `rng` is drawn from only where a straight path fails.
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
    search = _Search(at, T_base_world, rng, prepared.params.path_iterations)
    tried: set[int] = set()
    furthest = 0
    for k in order.tolist():
        tried.add(int(prepared.grasp[rows[k]]))
        outcome, plan = _try_grasp(search, int(rows[k]), T_base_tcp[k], seeds[k])
        furthest = max(furthest, STAGES.index(outcome))
        if plan is not None or outcome == "no_start":
            return PlanReport(outcome, plan, prepared.grasps_free, len(tried))
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
    found = _reach(search, homes, q_pregrasp, opening_m)
    if found is None:
        return "no_path", None
    home, q_reach = found
    approach = back[::-1]
    length = sum(float(np.linalg.norm(np.diff(q, axis=0), axis=1).sum()) for q in (q_reach, approach))
    some = np.linspace(0, len(q_reach) - 1, _CLEARANCE_POSES).round().astype(np.int64)
    clearance_m = at.clearance_m(q_reach[some], opening_m)
    plan = MotionPlan(int(scene.grasp[k]), home, q_reach, approach, lift, opening_m, length, clearance_m)
    return "success", plan


def _reach(search: _Search, homes: np.ndarray, q_pregrasp: F64, opening_m: float) -> tuple[int, F64] | None:
    """A free path (M, A), and the tucked pose it starts from."""
    scene = search.at.scene
    robot, step_rad = scene.robot, scene.params.check_step_rad

    def first_blocked(q_rad: F64) -> int:
        return search.at.first_blocked(q_rad, opening_m)

    gaps = np.linalg.norm(robot.homes_rad[homes] - q_pregrasp, axis=1)
    nearest = homes[np.argsort(gaps, kind="stable")]
    for home in nearest[:_STARTS].tolist():
        if is_line_free(robot.homes_rad[home], q_pregrasp, first_blocked, step_rad):
            return home, straight(robot.homes_rad[home], q_pregrasp, step_rad)
    home = int(nearest[0])
    corners, used = connect(
        robot.homes_rad[home],
        q_pregrasp,
        np.maximum(robot.q_lower_rad, -np.pi),
        np.minimum(robot.q_upper_rad, np.pi),
        first_blocked,
        step_rad,
        search.iterations_left,
        search.rng,
    )
    search.iterations_left -= used
    if corners is None:
        return None
    return home, shortened(dense(corners, step_rad), first_blocked, step_rad, _SHORTCUTS, search.rng)

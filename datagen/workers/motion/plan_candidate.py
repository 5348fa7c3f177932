"""Plan from one base pose: inverse kinematics, path, approach and lift, or the cause of failure."""

from __future__ import annotations

import copy

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import inverse
from datagen.workers.motion import MotionPlan, PlanReport
from datagen.workers.motion.compiled.compiler import in_memory
from datagen.workers.motion.compiled.search import SUCCESS, Plan, search
from datagen.workers.motion.planning_scene import ROOM_AROUND_M, PlanningScene

# The order of checks of a grasp, cheap ones first. A later cause of failure means more progress.
STAGES = ("no_ik", "arm_collision", "no_start", "no_approach", "no_lift", "no_path", "success")


def plan_candidate(
    prepared: PlanningScene, T_world_base: F64, rng: np.random.Generator, skip: frozenset[int] = frozenset()
) -> PlanReport:
    """Search for a whole plan from the base pose (4, 4) to any grasp except those in `skip`.

    `skip` are rows of the GraspSet. The result depends on the arguments alone: neither on earlier candidates
    nor on time. `rng` is used only where no grasp has a straight path, and for poses near the grasps that came
    furthest; `grasp` of such a plan is -1.
    """
    around = prepared.around
    poses = around.poses
    if skip:
        is_skipped = np.isin(around.grasp, sorted(skip))
        poses = poses._replace(holds=np.where(is_skipped, np.int8(-1), poses.holds))
    if around.grasps_free == 0 or (poses.holds < 0).all():
        return PlanReport("no_grasp", None, around.grasps_free, 0)
    robot, skips = prepared.robot, 0
    T_root = np.ascontiguousarray(T_world_base[:3])
    reach_m = robot.reach_m + ROOM_AROUND_M
    state = copy.deepcopy(rng.bit_generator.state)
    while True:
        # Each search draws the same numbers: it goes on behind plans that were found not to hold.
        rng.bit_generator.state = state
        plan: Plan = search(
            prepared.arm, around.hand, around.room, prepared.limits, poses, around.first, T_root, reach_m,
            robot.shoulder_m, prepared.params.nearby_rounds or 0, skips, rng,
        )  # fmt: skip
        if plan.stage != SUCCESS:
            return PlanReport(STAGES[plan.stage], None, around.grasps_free, plan.tried)
        score = _score(prepared, plan)
        if not plan.asks or score >= around.grasps.min_score:
            return PlanReport("success", _motion_plan(prepared, plan, score), around.grasps_free, plan.tried)
        if plan.pose >= 0:
            poses.holds[plan.pose] = -1
        else:
            skips += 1


def _score(prepared: PlanningScene, plan: Plan) -> float:
    """Share of floating-hand pulls that hold at the plan's grasp."""
    around = prepared.around
    if plan.pose >= 0:
        return around.grasps.score_of(int(around.grasp[plan.pose]))
    T_object_tcp = inverse(around.T_world_target) @ np.concatenate([plan.T_world_tcp, [[0, 0, 0, 1]]])
    assert around.grasps.pose_score is not None
    return around.grasps.pose_score(T_object_tcp, float(around.opening_m[plan.opening]))


def _motion_plan(prepared: PlanningScene, plan: Plan, score: float) -> MotionPlan:
    around = prepared.around
    if plan.pose >= 0:
        around.poses.holds[plan.pose] = 1
    grasp = int(around.grasp[plan.pose]) if plan.pose >= 0 else -1
    opening_m = float(around.opening_m[plan.opening])
    return MotionPlan(
        grasp, plan.home, plan.q_reach, plan.q_approach, plan.q_lift, opening_m, plan.length, plan.clearance_m,
        score,
    )  # fmt: skip

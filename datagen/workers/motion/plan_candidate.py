"""Plan from one base pose: inverse kinematics, path, approach and lift, or the cause of failure."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import inverse
from datagen.workers.motion import MotionPlan, PlanReport
from datagen.workers.motion.compiled import search as compiled
from datagen.workers.motion.compiled.compiler import in_memory
from datagen.workers.motion.planning_scene import ROOM_AROUND_M, PlanningScene
from datagen.workers.robots.kinematic_tree import Bools

# The order of checks of a grasp, cheap ones first. A later cause of failure means more progress.
STAGES = ("no_ik", "arm_collision", "no_start", "no_approach", "no_lift", "no_path", "success")
_NO_START, _NO_APPROACH, _NO_LIFT, _SUCCESS = 2, 3, 4, 6
_PORTION = 96  # poses ordered together at first; each further portion is as large as all before
_SHORT = 8  # poses tried to tell a lift that is too far from no solution
# The search near poses: poses in a round, the most that they are near, and those for which IK is tried.
_NEARBY, _ORIGINS, _NEARBY_TRIED = 480, 24, 48


def plan_candidate(
    prepared: PlanningScene, T_world_base: F64, rng: np.random.Generator, skip: frozenset[int] = frozenset()
) -> PlanReport:
    """Search for a whole plan from the base pose (4, 4) to any grasp except those in `skip`.

    `skip` are rows of the GraspSet. The result depends on the arguments alone: neither on earlier candidates
    nor on time. `rng` is used only where no grasp has a straight path, and for poses near the grasps that came
    furthest; `grasp` of such a plan is -1.
    """
    around = prepared.around
    allowed = ~np.isin(around.grasp, sorted(skip)) if skip else np.ones(len(around.grasp), np.bool_)
    if around.grasps_free == 0 or not allowed.any():
        return PlanReport("no_grasp", None, around.grasps_free, 0)
    search = _Search(prepared, np.ascontiguousarray(T_world_base[:3]), rng)
    plan = _search_grasps(search, allowed)
    if plan is None and search.furthest >= _NO_APPROACH:
        plan = _search_nearby(search)
    outcome = STAGES[search.furthest] if plan is None else "success"
    return PlanReport(outcome, plan, around.grasps_free, search.tried)


@dataclass(eq=False)
class _Search:
    """State of the search for one candidate."""

    scene: PlanningScene
    T_root: F64  # (3, 4)
    rng: np.random.Generator
    tried: int = 0  # poses for which inverse kinematics was tried
    furthest: int = 0  # stage
    stages: dict[int, int] = field(default_factory=dict)  # the stage each pose reached, in this order
    far: list[tuple[int, int]] = field(
        default_factory=list
    )  # row and opening of poses without a straight path

    def __post_init__(self) -> None:
        scene, around = self.scene, self.scene.around
        reach_m = scene.robot.reach_m + ROOM_AROUND_M
        center_m = self.T_root[:, :3] @ scene.robot.shoulder_m + self.T_root[:, 3]
        is_near = (around.low_m <= center_m + reach_m) & (around.high_m >= center_m - reach_m)
        rows = np.flatnonzero(is_near.all(axis=1))
        is_stuck = compiled.is_stuck(scene.arm, around.room, self.T_root, rows)
        count, searches = len(scene.robot.joint_names), compiled.SEARCHES
        self.filled, self.far_T = np.zeros(1, np.int64), np.empty((searches, 3, 4))
        self.base = in_memory(
            compiled.Base(
                self.T_root, rows, np.zeros(len(scene.robot.homes_rad), np.int8),
                self.far_T, np.empty((searches, 2, count)), self.filled, is_stuck,
            )
        )  # fmt: skip
        self.at = (scene.arm, around.hand, around.room, scene.limits, self.base)
        self.work, self.found = compiled.new_search(*self.at[:4])

    def try_pose(self, row: int, T_world_tcp: F64, opening: int) -> tuple[int, MotionPlan | None]:
        """The stage that a free pose (3, 4) of the hand leads to, and the plan where it is a success that holds."""
        self.tried += 1
        stage, home = compiled.try_pose(*self.at, T_world_tcp, opening, self.work, self.found)
        self.furthest = max(self.furthest, min(stage, _SUCCESS - 1))
        if self.filled[0] > len(self.far):
            self.far += [(row, opening)] * (int(self.filled[0]) - len(self.far))
        if stage < _SUCCESS or not self.holds(row, T_world_tcp, opening):
            return min(stage, _SUCCESS - 1), None
        path = compiled.straight_path(self.scene.arm, home, self.scene.limits, self.found)
        return stage, self.plan(row, T_world_tcp, opening, home, path)

    def holds(self, row: int, T_world_tcp: F64, opening: int) -> bool:
        """Whether the hand holds the object at a pose; simulated on first use."""
        around = self.scene.around
        if row < 0:
            return self.score(row, T_world_tcp, opening) >= around.grasps.min_score
        return around.grasps.holds(int(around.grasp[row]))

    def score(self, row: int, T_world_tcp: F64, opening: int) -> float:
        """Share of floating-hand pulls that hold."""
        around = self.scene.around
        if row >= 0:
            return around.grasps.score_of(int(around.grasp[row]))
        T = inverse(around.T_world_target) @ np.concatenate([T_world_tcp, [[0.0, 0.0, 0.0, 1.0]]])
        assert around.grasps.pose_score is not None
        return around.grasps.pose_score(T, float(around.opening_m[opening]))

    def plan(self, row: int, T_world_tcp: F64, opening: int, home: int, q_reach: F64) -> MotionPlan:
        """The whole plan with the lines that were found last."""
        around = self.scene.around
        lines = compiled.whole_plan(*self.at, opening, home, q_reach, self.found, self.work)
        return MotionPlan(
            int(around.grasp[row]) if row >= 0 else -1,
            home,
            *lines[:3],
            float(around.opening_m[opening]),
            lines.length,
            lines.clearance_m,
            self.score(row, T_world_tcp, opening),
        )

    def search_paths(self) -> MotionPlan | None:
        """Search a path to the first poses without a straight one; they share the iterations evenly."""
        left = self.scene.params.path_iterations
        for k, (row, opening) in enumerate(self.far):
            share = left // (len(self.far) - k)
            path, home, used = compiled.path_to(*self.at, k, opening, share, self.work, self.found, self.rng)
            left -= used
            T = self.far_T[k]
            if len(path) and self.holds(row, T, opening):
                return self.plan(row, T, opening, home, path)
        return None

    def forget_far(self) -> None:
        """Begin a new list of poses without a straight path."""
        self.far, self.filled[0] = [], 0


def _search_grasps(search: _Search, allowed: Bools) -> MotionPlan | None:
    """Try the scene's poses, in portions of their order, in which neighbours differ much; best ones first."""
    around, limits = search.scene.around, search.scene.params
    poses = (
        around.poses if allowed.all() else in_memory(around.arrays._replace(holds=np.where(allowed, 0, -1)))
    )
    short = np.full(_SHORT, -1)
    start, end = 0, max(around.first, _PORTION)
    while start < len(allowed) and search.tried < limits.max_grasps_tried:
        rows = compiled.best_first(*search.at, poses, start, min(end, len(allowed)), short, search.work)
        for k in rows[: limits.max_grasps_tried - search.tried].tolist():
            plan = _try_row(search, k)
            if plan is not None or search.furthest == _NO_START:
                return plan
        start, end = end, 2 * end
    # They get no further than the lift.
    for k in short[short >= 0].tolist():
        if search.furthest < _NO_LIFT:
            _try_row(search, k)
    return search.search_paths()


def _try_row(search: _Search, k: int) -> MotionPlan | None:
    arrays = search.scene.around.arrays
    stage, plan = search.try_pose(k, arrays.T_world_tcp[k], int(arrays.opening[k]))
    search.stages[k] = stage
    return plan


def _search_nearby(search: _Search) -> MotionPlan | None:
    """Search near the poses that came furthest, then near the best poses found."""
    arrays = search.scene.around.arrays
    rows = sorted(search.stages, key=lambda k: -search.stages[k])[:_ORIGINS]
    T, opening, motion = arrays.T_world_tcp[rows], arrays.opening[rows], np.zeros((len(rows), 5))
    for _ in range(search.scene.params.nearby_rounds or 0):
        if len(T) == 0:
            break
        search.forget_far()
        each = _NEARBY // len(T)
        T_near, moved, order = compiled.poses_near(
            *search.at, T, motion, opening, each, search.work, search.rng
        )
        stages: dict[int, int] = {}
        for k in order[:_NEARBY_TRIED].tolist():
            stages[k], plan = search.try_pose(-1, T_near[k], int(opening[k // each]))
            if plan is not None:
                return plan
        plan = search.search_paths()
        if plan is not None:
            return plan
        best = np.array(sorted(stages, key=lambda k: -stages[k])[:_ORIGINS], np.int64)
        T, motion, opening = T[best // each], moved[best], opening[best // each]
    return None

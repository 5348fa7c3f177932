"""Plan from one base pose: inverse kinematics, path, approach and lift, or the cause of failure."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import inverse
from datagen.workers.kinematics.compiler import in_memory
from datagen.workers.kinematics.tree import Bools, Ints
from datagen.workers.motion import MotionPlan, PlanReport
from datagen.workers.motion.arm_motion import search_at
from datagen.workers.motion.hand_motion import Poses, points_on
from datagen.workers.motion.path_search import dense
from datagen.workers.motion.planning_scene import ROOM_AROUND_M, PlanningScene
from datagen.workers.motion.search import (
    ARM_COLLISION,
    NO_IK,
    NO_LIFT,
    NO_START,
    NOT_FREE,
    SUCCESS,
    length_and_clearance,
    path_to,
    samples_near,
    try_until,
)

STAGES = ("no_ik", "arm_collision", "no_start", "no_approach", "no_lift", "no_path", "success")
_SEARCHES = 4  # grasps for which a path is searched where no straight path is free
_PORTION = 96  # poses ordered together at first; each further portion is as large as all before
_SHORT = 8  # poses tried to tell a lift that is too far from no solution
# The search near poses: poses in a round, the most that they are near, and those for which IK is tried.
_NEARBY, _ORIGINS, _NEARBY_TRIED = 480, 24, 48
_MOST_SLIPPED = 4  # that are simulated: where these do not hold, others seldom do
# In each round and in all: a turn about the closing axis; tilts about the pads' width and the approach,
# within the contacts' friction cone; shifts along them, by less than half a pad.
_MOTION_STD = np.array([np.radians(20), np.radians(3), np.radians(3), 0.003, 0.003])
_MOST_MOTION = np.array([np.inf, np.radians(8), np.radians(8), 0.006, 0.006])


def plan_candidate(
    prepared: PlanningScene, T_world_base: F64, rng: np.random.Generator, skip: frozenset[int] = frozenset()
) -> PlanReport:
    """Search for a whole plan from the base pose (4, 4) to any grasp except those in `skip`.

    `skip` are rows of the GraspSet. The result depends on the arguments alone: neither on earlier candidates
    nor on time. `rng` is used only where no grasp has a straight path, and for poses near the grasps that
    came furthest; `grasp` of such a plan is -1.
    """
    around = prepared.around
    allowed = ~np.isin(around.grasp, sorted(skip)) if skip else np.ones(len(around.grasp), np.bool_)
    if around.grasps_free == 0 or not allowed.any():
        return PlanReport("no_grasp", None, around.grasps_free, 0)
    search = _Search(prepared, np.ascontiguousarray(T_world_base[:3]), rng)
    stages = dict[int, int]()
    plan = _among_grasps(search, allowed, stages)
    if plan is None and search.furthest not in (ARM_COLLISION, NO_START):
        plan = _near_grasps(search, _furthest(stages))
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
    slipped: int = 0  # poses near grasps that did not hold
    score: float = 0.0  # share of floating-hand pulls that the pose looked at last holds
    # The row (-1: none), pose and opening of each grasp without a straight path.
    without_path: list[tuple[int, F64, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        scene, around = self.scene, self.scene.around
        reach_m = scene.robot.reach_m + ROOM_AROUND_M
        center_m = self.T_root[:, :3] @ scene.robot.shoulder_m + self.T_root[:, 3]
        is_near = (around.low_m <= center_m + reach_m) & (around.high_m >= center_m - reach_m)
        rows = np.flatnonzero(is_near.all(axis=1))
        at, limits, count = (scene.arm, around.hand, around.room), scene.limits, len(scene.robot.joint_names)
        back, rise = (points_on(m, limits.line_step_m) for m in (limits.pregrasp_m, limits.lift_m))
        self.back = np.empty((_SEARCHES + 1, back, count))  # lines of grasps, as `Work` has them
        self.lift = np.empty((_SEARCHES + 1, rise, count))
        self.found = np.zeros(1, np.int64)
        self.compiled = search_at(
            *at, scene.compiled_limits, self.T_root, rows, self.back, self.lift, self.found
        )

    def best_first(self, poses: Poses, start: int, end: int) -> tuple[Ints, Ints]:
        """The poses from `start` to `end` that can be reached and lifted from, those with most samples near
        first, and those that can be reached and not lifted from."""
        near = np.zeros(end - start, np.int64)
        samples_near(self.compiled, poses, start, end, near)
        order = np.argsort(-near, kind="stable")[: np.count_nonzero(near > 0)]
        return start + order, start + np.flatnonzero(near < 0)

    def try_poses(
        self, poses: Poses, arrays: Poses, rows: Ints, most: int, of_grasps: bool, stages: dict[int, int]
    ) -> MotionPlan | None:
        """The plan of the first of these rows of the poses that has one, of at most `most` free ones.

        `arrays` are the poses before they were put in memory. `stages` gets how far each came.
        """
        start, end, reached = 0, self.tried + most, np.empty(len(rows), np.int64)
        while start < len(rows) and self.tried < end:
            past, home = try_until(self.compiled, poses, rows, start, end - self.tried, reached)
            free = start + np.flatnonzero(reached[start:past] != NOT_FREE)
            found, stage, start = int(self.found[0]), int(reached[past - 1]), past
            known = np.minimum(reached[free], SUCCESS - 1).tolist()
            stages.update(zip(rows[free].tolist(), known, strict=True))
            self.tried, self.furthest = self.tried + len(free), max(self.furthest, *known, NO_IK)
            k = int(rows[past - 1])
            row, T, opening = k if of_grasps else -1, arrays.T_world_tcp[k], int(arrays.opening[k])
            if stage == SUCCESS and self.holds(row, T, opening):
                corners = np.stack([self.scene.robot.homes_rad[home], self.back[found, -1]])
                path = dense(self.scene.weight, corners, self.scene.limits.step)
                return self.plan(found, row, opening, home, path)
            self.without_path += [(row, T, opening)] * (found - len(self.without_path))
            if self.furthest == NO_START:
                return None
        return None

    def search_paths(self) -> MotionPlan | None:
        """Search a path to the first grasps without a straight one; they share the iterations evenly."""
        left = self.scene.params.path_iterations
        for k, (row, T, opening) in enumerate(self.without_path):
            share = left // (len(self.without_path) - k)
            path, home, used = path_to(self.compiled, k, opening, share, self.rng)
            left -= used
            if len(path) and self.holds(row, T, opening):
                return self.plan(k, row, opening, home, path)
        self.without_path, self.found[0] = [], 0
        return None

    def holds(self, row: int, T_world_tcp: F64, opening: int) -> bool:
        """Whether the hand holds the object at a pose; simulated on first use."""
        around, grasps = self.scene.around, self.scene.around.grasps
        if row >= 0:
            self.score = grasps.score_of(int(around.grasp[row]))
            return grasps.holds(int(around.grasp[row]))
        if self.slipped >= _MOST_SLIPPED:
            return False
        assert grasps.pose_score is not None
        T = inverse(around.T_world_target) @ np.concatenate([T_world_tcp, [[0.0, 0.0, 0.0, 1.0]]])
        self.score = grasps.pose_score(T, float(around.opening_m[opening]))
        is_held = self.score >= grasps.min_score
        self.slipped += not is_held
        return is_held

    def plan(self, found: int, row: int, opening: int, home: int, q_reach: F64) -> MotionPlan:
        """The whole plan along the lines `found`, to the pose that was last found to hold."""
        around = self.scene.around
        length, clearance_m = length_and_clearance(self.compiled, found, opening, q_reach)
        return MotionPlan(
            int(around.grasp[row]) if row >= 0 else -1,
            home,
            q_reach,
            self.back[found, ::-1].copy(),
            self.lift[found].copy(),
            float(around.opening_m[opening]),
            length,
            clearance_m,
            self.score,
        )


def _among_grasps(search: _Search, allowed: Bools, stages: dict[int, int]) -> MotionPlan | None:
    """Try the scene's poses, in portions of their order, in which neighbours differ much; best ones first."""
    around, most = search.scene.around, search.scene.params.max_grasps_tried
    arrays, poses = around.arrays, around.poses
    if not allowed.all():
        poses = in_memory(arrays._replace(allowed=allowed))
    shorts, start, end = list[Ints](), 0, max(around.first, _PORTION)
    while start < len(allowed) and search.tried < most and search.furthest != NO_START:
        rows, short = search.best_first(poses, start, min(end, len(allowed)))
        shorts.append(short)
        plan = search.try_poses(poses, arrays, rows, most - search.tried, True, stages)
        if plan is not None:
            return plan
        start, end = end, 2 * end
    if NO_START != search.furthest < NO_LIFT:  # the others get no further than the lift
        search.try_poses(poses, arrays, np.concatenate(shorts), _SHORT, True, stages)
    return search.search_paths()


def _furthest(stages: dict[int, int]) -> list[int]:
    """The poses that came furthest, at most as many as the search near them begins with."""
    return sorted(stages, key=lambda k: -stages[k])[:_ORIGINS]


def _near_grasps(search: _Search, rows: list[int]) -> MotionPlan | None:
    """Search near the poses that came furthest, then near the best poses found."""
    arrays = search.scene.around.arrays
    T, opening, motion = arrays.T_world_tcp[rows], arrays.opening[rows], np.zeros((len(rows), 5))
    for _ in range(search.scene.params.nearby_rounds or 0):
        if len(T) == 0 or search.slipped >= _MOST_SLIPPED:
            break
        each = _NEARBY // len(T)
        T, opening = np.repeat(T, each, axis=0), np.repeat(opening, each)
        near, motion = _varied(T, np.repeat(motion, each, axis=0), search.rng)
        arrays, stages = Poses.unknown(near, opening), dict[int, int]()
        poses = in_memory(arrays)
        order, _ = search.best_first(poses, 0, len(T))
        plan = search.try_poses(poses, arrays, order, _NEARBY_TRIED, False, stages) or search.search_paths()
        if plan is not None:
            return plan
        rows = _furthest(stages)
        T, opening, motion = T[rows], opening[rows], motion[rows]
    return None


def _varied(T: F64, motion: F64, rng: np.random.Generator) -> tuple[F64, F64]:
    """Poses (N, 3, 4) and motions (N, 5): random ones near the given motions of grasps, in their own frames.

    A motion is a turn about y, tilts about x and z, shifts along x and z. Both fingers keep their contacts,
    so that most of these poses hold the object as the grasp does.
    """
    motion = motion + rng.standard_normal(motion.shape) * _MOTION_STD
    motion = np.clip(motion, -_MOST_MOTION, _MOST_MOTION)
    R = T[:, :, :3]
    shift_m = np.einsum("nij,nj->ni", R[:, :, [0, 2]], motion[:, 3:])
    for axis, angle_rad in zip((1, 0, 2), motion[:, :3].T, strict=True):
        R = np.matmul(R, _rotations(axis, angle_rad))
    return np.concatenate([R, (T[:, :, 3] + shift_m)[:, :, None]], axis=2), motion


def _rotations(axis: int, angle_rad: F64) -> F64:
    """Rotations (N, 3, 3) about one axis of the frame by angles (N,)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.tile(np.eye(3), (len(angle_rad), 1, 1))
    R[:, i, i], R[:, i, j], R[:, j, i], R[:, j, j] = c, -s, s, c
    return R

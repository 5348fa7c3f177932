"""Plan from one base pose: inverse kinematics, path, approach and lift, or the cause of failure."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import islice

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import inverse
from datagen.workers.motion.arm_collision import Surroundings, surroundings
from datagen.workers.motion.cartesian_path import follow_line
from datagen.workers.motion.collision import Bools, Ints
from datagen.workers.motion.grasp_filter import backed, line_offsets_m, raised
from datagen.workers.motion.motion_plan import MotionPlan, PlanReport
from datagen.workers.motion.planning_scene import PlanningScene
from datagen.workers.motion.rrt_connect import connect, dense, is_line_free, shortened, straight

# The order of checks of a grasp, cheap ones first: a path is searched only for grasps with approach and
# lift. A later cause of failure means more progress.
STAGES = ("no_ik", "arm_collision", "no_start", "no_approach", "no_lift", "no_path", "success")
_STARTS = 3  # tucked poses from which a straight line is tried
_SEARCHES = 4  # grasps for which a path is searched where no straight path is free
_SHORTCUTS = 20
_CLEARANCE_POSES = 8
_FIRST_BATCH, _LARGEST_BATCH = 2, 64  # grasps checked together
# Poses are sorted by distance in portions; each has this many more than all before it.
_FIRST_PORTION = 24
_FILTERED_AT_ONCE = 200
_SAME_RAD = 0.05  # solutions of one grasp that differ by less count as one


@dataclass(eq=False)
class _Search:
    """State of the search for one candidate, shared by its grasps."""

    scene: PlanningScene
    T_world_base: F64
    T_base_world: F64
    far: list[_Reachable] = field(default_factory=list)  # without a free straight path
    furthest: str = "no_ik"

    @cached_property
    def at(self) -> Surroundings:
        return surroundings(self.scene, self.T_world_base)

    def reached(self, stage: str) -> None:
        """Record a stage if it is the furthest so far."""
        self.furthest = max(self.furthest, stage, key=STAGES.index)

    def holds(self, k: int) -> bool:
        """Whether the hand holds the object in kept grasp `k`; simulated on first use."""
        return self.scene.around.holds(int(self.scene.around.grasp[k]))


@dataclass(frozen=True, eq=False)
class _Goal:
    """A kept grasp, seen from the base."""

    k: int
    T_base_tcp: F64  # (4, 4)
    seeds_rad: F64  # (S, A)
    limit: str  # furthest stage that it can reach


@dataclass(frozen=True, eq=False)
class _Way:
    """Joints at a grasp and at its pregrasp."""

    goal: _Goal
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
    nor on time. `rng` is used only where no grasp has a straight path.
    """
    around = prepared.around
    kept, rest = (rows[~np.isin(around.grasp[rows], sorted(skip))] for rows in (around.kept, around.rest))
    if around.grasps_free == 0 or len(kept) + len(rest) == 0:
        return PlanReport("no_grasp", None, around.grasps_free, 0)
    search = _Search(prepared, T_world_base, inverse(T_world_base))
    plan, tried = None, set[int]()
    for goals in _goals(prepared, search.T_base_world, kept, rest):
        tried.update(int(around.grasp[goal.k]) for goal in goals)
        plan = _try_goals(search, goals)
        if plan is not None or search.furthest == "no_start":
            break
    if plan is None and search.furthest != "no_start":
        plan = _search_paths(search, rng)
    outcome = search.furthest if plan is None else "success"
    return PlanReport(outcome, plan, around.grasps_free, len(tried))


def _goals(prepared: PlanningScene, T_base_world: F64, kept: Ints, rest: Ints) -> Iterator[list[_Goal]]:
    """At most `max_grasps_tried` of the free poses `kept` and `rest` with seeds near by, in growing batches.

    `kept` come first, in portions of their order, in which neighbours differ much; in each portion, the poses
    nearest to a seed come first. `rest` are sorted by that distance as a whole.
    """
    table, left, batch = prepared.moving.table, prepared.params.max_grasps_tried, _FIRST_BATCH
    for rows, portion in ((kept, _FIRST_PORTION), (rest, len(rest))):
        if left == 0:
            return
        T_base_tcp = np.matmul(T_base_world, prepared.around.T_world_tcp[rows])
        within = _is_within_reach(prepared, T_base_world, T_base_tcp)
        rows, T_base_tcp = rows[within], T_base_tcp[within]
        end = 0
        while left > 0 and end < len(rows):
            start, end = end, min(len(rows), 2 * end + portion)
            k, T = rows[start:end], T_base_tcp[start:end]
            near = _is_wrist_within_reach(prepared, T_base_world, T, table.limit_m).all(axis=0)
            k, T = k[near], T[near]
            nearest = _nearest_first(prepared, T_base_world, T, table.distance(T))
            # The hand's motion is checked for few at a time: most candidates need no more.
            while left > 0 and (some := list(islice(nearest, _FILTERED_AT_ONCE))):
                free = np.array(some)[prepared.around.is_free(k[some])][:left]
                left -= len(free)
                while len(free):
                    now, free = np.split(free, [batch])
                    seeds = table.seeds(T[now], prepared.params.ik_seeds)
                    limits = _limits(prepared, T_base_world, T[now])
                    yield list(map(_Goal, k[now].tolist(), T[now], seeds, limits))
                    batch = min(2 * batch, _LARGEST_BATCH)


def _nearest_first(
    prepared: PlanningScene, T_base_world: F64, T_base_tcp: F64, distance: F64
) -> Iterator[int]:
    """Rows of the poses (G, 4, 4) with a sample near by, nearest first; `distance` (G,) is theirs.

    The pregrasp and the end of the lift need a sample near by too: the largest of the three distances counts.
    It is computed for few poses at a time, because it is never smaller than `distance`.
    """
    order = np.argsort(distance, kind="stable")[: int(np.isfinite(distance).sum())]
    waiting: list[tuple[float, int]] = []
    for start in range(0, len(order), _FILTERED_AT_ONCE):
        rows, later = np.split(order[start:], [_FILTERED_AT_ONCE])
        ends = np.concatenate(_line_ends(prepared, T_base_world, T_base_tcp[rows]))
        at_ends = prepared.moving.table.distance(ends).reshape(2, -1).max(axis=0)
        farthest = np.maximum(distance[rows], at_ends)
        waiting = sorted([*waiting, *zip(farthest.tolist(), rows.tolist(), strict=True)])
        bound = float(distance[later[0]]) if len(later) else np.inf
        ready = bisect_left(waiting, (bound, -1))
        yield from (row for _, row in waiting[:ready])
        waiting = waiting[ready:]


def _line_ends(prepared: PlanningScene, T_base_world: F64, T_base_tcp: F64) -> tuple[F64, F64]:
    """The pregrasp and the end of the lift (G, 4, 4) of each grasp."""
    T_lifted = T_base_tcp.copy()
    T_lifted[:, :3, 3] += prepared.params.lift_m * T_base_world[:3, 2]
    return backed(T_base_tcp, prepared.params.pregrasp_m), T_lifted


def _limits(prepared: PlanningScene, T_base_world: F64, T_base_tcp: F64) -> list[str]:
    """The furthest stage that each grasp (G, 4, 4) can reach, by the length of the arm up to its wrist."""
    grasp, pregrasp, lifted = _is_wrist_within_reach(prepared, T_base_world, T_base_tcp, 0.0)
    return np.where(grasp & pregrasp, np.where(lifted, "success", "no_lift"), "no_ik").tolist()


def _is_wrist_within_reach(
    prepared: PlanningScene, T_base_world: F64, T_base_tcp: F64, beyond_m: float
) -> Bools:
    """Whether the wrist is at most `beyond_m` beyond reach (3, G): at grasp, pregrasp and end of the lift."""
    poses = (T_base_tcp, *_line_ends(prepared, T_base_world, T_base_tcp))
    return np.array([prepared.robot.is_wrist_within_reach(T, beyond_m) for T in poses])


def _is_within_reach(prepared: PlanningScene, T_base_world: F64, T_base_tcp: F64) -> Bools:
    """Whether the TCP is within reach (G,) at the grasp, at the pregrasp and at the end of the lift."""
    robot, params = prepared.robot, prepared.params
    to_grasp = T_base_tcp[:, :3, 3] - robot.shoulder_m
    ways = (0.0, -params.pregrasp_m * T_base_tcp[:, :3, 2], params.lift_m * T_base_world[:3, 2])
    farthest_m = np.max([np.linalg.norm(to_grasp + way, axis=1) for way in ways], axis=0)
    return farthest_m <= robot.reach_m


def _try_goals(search: _Search, goals: list[_Goal]) -> MotionPlan | None:
    """Search for a plan to some grasps: collisions are checked together, all else one by one.

    Grasps that cannot get further than earlier ones are left out.
    """
    so_far = STAGES.index(search.furthest)
    goals = [goal for goal in goals if STAGES.index(goal.limit) > so_far]
    ways = [way for goal in goals for way in _ways(search.scene, goal)]
    if not ways:
        return None
    search.reached("arm_collision")
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


def _ways(scene: PlanningScene, goal: _Goal) -> list[_Way]:
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
            search.T_base_world @ raised(scene.around.T_world_tcp[k], float(r))
            for r in line_offsets_m(params.lift_m)
        ]
    )
    search.reached("no_approach")
    T_back = np.stack([backed(T_base_tcp, float(b)) for b in line_offsets_m(params.pregrasp_m)])
    # The end of the lift is checked first: where the arm is too short for it, the lines cost most.
    if way.goal.limit == "no_lift" or robot.ik(T_up[-1], way.q_grasp) is None:
        search.reached("no_lift")
        return None
    back = follow_line(at, T_back, way.q_grasp, way.q_pregrasp, is_target_held=False)
    if back is None:
        return None
    search.reached("no_lift")
    lift = follow_line(at, T_up, way.q_grasp, None, is_target_held=True)
    if lift is None:
        return None
    search.reached("no_path")
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
    return MotionPlan(
        grasp, home, q_reach, found.q_approach_rad, found.q_lift_rad, opening_m, length, clearance_m
    )

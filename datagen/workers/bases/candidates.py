"""Sample base positions around the target and their robots (GBPP, Sec. IV-A)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from datagen.schemas.fields import facing_rad
from datagen.schemas.specification import CandidateParams, Range
from datagen.workers.bases.clearance import (
    Footprint,
    HouseObstacles,
    ObstacleDistances,
    base_clearance_m,
    distances_from_obstacles,
)
from datagen.workers.geometry.mesh import F32, F64

if TYPE_CHECKING:  # it needs the compiler
    from datagen.workers.motion.reachable_set import ReachableSet


# Rounds over all cells, each with new jitter, in which a robot must find its positions.
ROUNDS = 8
# Robots sampled per robot that a scene needs, before the scene is rejected.
DRAWS_A_ROBOT = 16


@dataclass(frozen=True, eq=False)
class SceneCandidates:
    """N base poses of one scene. Numbers are float32, as stored, so that labels can be recomputed."""

    base_xy_m: F32  # (N, 2), world
    base_yaw_rad: F32  # (N,), heading of the base, world
    robot_index: npt.NDArray[np.int16]  # (N,)
    camera_height_m: F32  # (N,)
    base_height_m: F32  # (N,)
    arm_reach_m: F32  # (N,)
    clearance_m: F32  # (N,), free distance around the robot's body; below 0 it does not fit
    # (N,), index of each candidate in its scene; by default 0 to N - 1
    index: npt.NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))

    def __post_init__(self) -> None:
        if len(self.index) != len(self):
            object.__setattr__(self, "index", np.arange(len(self), dtype=np.int32))

    def __len__(self) -> int:
        return len(self.base_xy_m)


@dataclass(frozen=True, eq=False)
class _SceneRobots:
    """The R robots of one scene."""

    camera_height_m: F32  # (R,)
    base_height_m: F32  # (R,)
    arm_reach_m: F32  # (R,)

    def __len__(self) -> int:
        return len(self.arm_reach_m)

    def rows(self, rows: list[int]) -> _SceneRobots:
        return _SceneRobots(self.camera_height_m[rows], self.base_height_m[rows], self.arm_reach_m[rows])


def grid_offsets(params: CandidateParams) -> F64:
    """Cell centres (cells^2, 2) of the square grid around the target, row by row from -x, -y.

    The outermost centres lie on the border, so that the grid spans +-grid_half_width_m.
    """
    axis = np.linspace(-params.grid_half_width_m, params.grid_half_width_m, params.grid_cells)
    y, x = np.meshgrid(axis, axis, indexing="ij")
    return np.stack([x.ravel(), y.ravel()], axis=1)


def footprint_of(params: CandidateParams) -> Footprint | None:
    """The polygon of the bases; None where they are circles."""
    return None if params.footprint_m is None else Footprint(params.footprint_m)


def draw_candidates(
    target_center_m: F64,
    obstacles: HouseObstacles,
    params: CandidateParams,
    rng: np.random.Generator,
    reach: ReachableSet | None = None,
) -> SceneCandidates | None:
    """Return all cells of the grid, or `per_scene` positions jittered within cells, with their robots.

    Cells are sampled from all without repetition, or from the set `within`. Candidates are assigned in turn
    to `robots_per_scene` robots, so that a model encodes a scene once per robot; or each has its own robot,
    as in the paper. Headings are relative to the direction to the target, and sampled last.

    With `within`, robots are sampled from their ranges one after another. A robot is kept if each of its
    candidates finds a position in the set; its sizes are then distributed as in the ranges, given that this
    target has room for it. There are `ROUNDS` rounds, each over all cells in random order with new jitter,
    and a robot uses the first cells in the set. The scene's robots share the rounds and use each cell of a
    round once. Returns None if too few of `DRAWS_A_ROBOT` times the needed robots are kept.

    In-range is where `reach` holds the target's centre, or without it within the robot's reach of its mount.
    """
    n = params.count
    n_robots = n if params.robot_per_candidate else min(params.robots_per_scene, n)
    robot_index = (np.arange(n) % n_robots).astype(np.int16)
    if params.within is None:
        base_xy_m = (target_center_m[:2] + _offsets(params, rng)).astype(np.float32)
        robots = _draw_robots(params, n_robots, rng)
        yaw_rad = _headings(base_xy_m, target_center_m, params, rng)
        return _with_clearance(base_xy_m, yaw_rad, robot_index, robots, obstacles, params)
    drawn = _draw_robots(params, DRAWS_A_ROBOT * n_robots, rng)
    rounds = _Rounds(target_center_m, obstacles, params, rng, reach)
    rows = np.empty(n, np.int64)
    kept: list[int] = []
    for robot in range(len(drawn)):
        own = robot_index == len(kept)
        found = rounds.take(drawn, robot, int(own.sum()))
        if found is not None:
            rows[own] = found
            kept.append(robot)
            if len(kept) == n_robots:
                poses = rounds.xy_m[rows], rounds.yaw_rad[rows]
                return _with_clearance(*poses, robot_index, drawn.rows(kept), obstacles, params)
    return None


def distances(candidates: SceneCandidates, target_center_m: F64) -> tuple[F32, F32]:
    """Horizontal distance base to target centre, and distance arm mount to target centre; each (N,)."""
    return _distances(candidates.base_xy_m, candidates.base_height_m, target_center_m)


def _distances(base_xy_m: F32, base_height_m: F32 | np.float32, target_center_m: F64) -> tuple[F32, F32]:
    planar_m = np.linalg.norm(base_xy_m.astype(np.float64) - target_center_m[:2], axis=1)
    rise_m = target_center_m[2] - np.asarray(base_height_m, np.float64)
    return planar_m.astype(np.float32), np.hypot(planar_m, rise_m).astype(np.float32)


def _offsets(params: CandidateParams, rng: np.random.Generator) -> F64:
    """Positions (N, 2) relative to the target: all cells, or a jittered subset."""
    offsets, n = grid_offsets(params), params.count
    if params.per_scene == "grid":
        return offsets
    return _jittered(offsets[rng.choice(len(offsets), size=n, replace=n > len(offsets))], params, rng)


def _jittered(offsets_m: F64, params: CandidateParams, rng: np.random.Generator) -> F64:
    if not params.jitter:
        return offsets_m
    cell = 2 * params.grid_half_width_m / (params.grid_cells - 1)
    return offsets_m + rng.uniform(-cell / 2, cell / 2, size=offsets_m.shape)


def _headings(base_xy_m: F32, target_center_m: F64, params: CandidateParams, rng: np.random.Generator) -> F32:
    """Headings (N,) in the world at positions (N, 2); random numbers are used only where they are sampled."""
    yaw_rad = facing_rad(target_center_m[:2] - base_xy_m)
    if params.yaw_rad is not None:
        low, high = params.yaw_rad.low, params.yaw_rad.high
        turned = yaw_rad + (rng.uniform(low, high, len(yaw_rad)) if params.samples_yaw else low)
        yaw_rad = (turned + np.pi) % (2 * np.pi) - np.pi
    return yaw_rad.astype(np.float32)


def _draw_robots(params: CandidateParams, n: int, rng: np.random.Generator) -> _SceneRobots:
    def draw(r: Range) -> F32:
        return rng.uniform(r.low, r.high, size=n).astype(np.float32)

    robots = _SceneRobots(draw(params.camera_height_m), draw(params.base_height_m), draw(params.arm_reach_m))
    return replace(robots, arm_reach_m=_stepped(robots.arm_reach_m, params))


def _stepped(reach_m: F32, params: CandidateParams) -> F32:
    """Reaches (R,) at the nearest whole step within the range."""
    step_m, limits = params.arm_reach_step_m, params.arm_reach_m
    if step_m == 0:
        return reach_m
    whole = np.round(reach_m.astype(np.float64) / step_m) * step_m
    return np.clip(whole, limits.low, limits.high).astype(np.float32)


def _with_clearance(
    base_xy_m: F32,
    yaw_rad: F32,
    robot_index: npt.NDArray[np.int16],
    robots: _SceneRobots,
    obstacles: HouseObstacles,
    params: CandidateParams,
) -> SceneCandidates:
    """SceneCandidates of robots at positions (N, 2) and headings (N,), world, with their clearance."""
    camera_m, base_m = robots.camera_height_m[robot_index], robots.base_height_m[robot_index]
    reach_m = robots.arm_reach_m[robot_index]
    radius_m = params.radius_of_base_m(reach_m)
    outline = footprint_of(params), yaw_rad
    clearance_m = base_clearance_m(
        base_xy_m, base_m, camera_m, radius_m, obstacles, params.mast_radius_m, *outline
    )
    return SceneCandidates(base_xy_m, yaw_rad, robot_index, camera_m, base_m, reach_m, clearance_m)


class _Rounds:
    """Rounds over the cells around a target, which give robots positions in the set."""

    def __init__(
        self,
        target_center_m: F64,
        obstacles: HouseObstacles,
        params: CandidateParams,
        rng: np.random.Generator,
        reach: ReachableSet | None,
    ) -> None:
        cells = grid_offsets(params)
        self._target_m, self._params = target_center_m, params
        self._reach = reach
        self._n_cells = len(cells)
        # The cells of all rounds, one round after the other.
        self._cell = np.concatenate([rng.permutation(len(cells)) for _ in range(ROUNDS)])
        self.xy_m = (target_center_m[:2] + _jittered(cells[self._cell], params, rng)).astype(np.float32)
        self.yaw_rad = _headings(self.xy_m, target_center_m, params, rng)
        self._footprint = footprint_of(params)
        outer_m = self._footprint.outer_m if self._footprint else params.base_radius_m
        highest_m = max(params.camera_height_m.high, params.base_height_m.high) + 1e-3
        self._near = obstacles.near(
            self.xy_m.astype(np.float64), highest_m, max(outer_m, params.mast_radius_m)
        )
        self._known = ObstacleDistances.unknown(len(self._cell), self._near, self._footprint is not None)
        self._is_known, self._free = np.zeros(len(self._cell), np.bool_), np.ones(len(self._cell), np.bool_)
        # Largest distance between two positions in one cell.
        step_m = 2 * params.grid_half_width_m / (params.grid_cells - 1)
        self._apart_m = np.sqrt(2.0) * step_m if params.jitter else 0.0
        # Rows of the first round with a position in the cell that the longest arm reaches; all for "clear".
        first_m = self.xy_m[: len(cells)].astype(np.float64) - target_center_m[:2]
        far_m = params.arm_reach_m.high if reach is None else reach.farthest_m
        far_m = np.inf if params.within == "clear" else far_m + self._apart_m
        self._first = np.flatnonzero(np.linalg.norm(first_m, axis=1) <= far_m)
        self._around = self._distances(self._first)
        # Only part of a cell may be indoors; a base at any heading holds the inner circle of its polygon.
        self._unbounded = replace(self._around, indoors=np.ones_like(self._around.indoors), base_m=None)

    def take(self, robots: _SceneRobots, robot: int, n: int) -> npt.NDArray[np.int64] | None:
        """Rows (n,) of poses for a robot, now marked as used; None if fewer are free and in the set."""
        rows = self._first
        radius_m = self._params.radius_of_base_m(robots.arm_reach_m[robot])
        margin_m = self._margins_m(rows, self._around, robots, robot, radius_m, exact=True)
        found = rows[(margin_m >= 0) & self._free[rows]]
        if len(found) < n:
            # Within a cell, clearance and distance differ by at most the distance between positions.
            is_possible = np.zeros(self._n_cells, np.bool_)
            least_m = radius_m if self._footprint is None else self._footprint.inner_m
            anywhere_m = self._margins_m(rows, self._unbounded, robots, robot, least_m, exact=False)
            is_possible[self._cell[rows[anywhere_m >= -self._apart_m]]] = True
            is_possible = is_possible[self._cell] & self._free
            later = self._n_cells + np.flatnonzero(is_possible[self._n_cells :])
            if len(found) + len(later) < n:
                return None
            margin_m = self._margins_m(later, self._distances(later), robots, robot, radius_m, exact=True)
            found = np.concatenate([found, later[margin_m >= 0]])
        if len(found) < n:
            return None
        self._free[found[:n]] = False
        return found[:n]

    def _distances(self, rows: npt.NDArray[np.int64]) -> ObstacleDistances:
        """Those of the rows' poses, each computed once for all robots."""
        known, new = self._known, rows[~self._is_known[rows]]
        if len(new):
            lowest_m = self._params.base_height_m.low - 1e-3  # heights of robots are rounded to float32
            xy_m, yaw_rad = self.xy_m[new].astype(np.float64), self.yaw_rad[new]
            found = distances_from_obstacles(
                xy_m, self._near, self._footprint, yaw_rad, lowest_m, only_signs=True
            )
            known.distance_m[new], known.indoors[new] = found.distance_m, found.indoors
            if known.base_m is not None and found.base_m is not None:
                known.base_m[new] = found.base_m
            self._is_known[new] = True
        return known.at(rows)

    def _margins_m(
        self,
        rows: npt.NDArray[np.int64],
        around: ObstacleDistances,
        robots: _SceneRobots,
        robot: int,
        radius_m: F64 | np.float64,
        exact: bool,
    ) -> F32:
        """The smaller of clearance and remaining reach (N,); not negative for positions in the set.

        A reachable set has no distance to its border: if not `exact`, that to all of it is given.
        """
        camera_m, mount_m, reach_m = (
            column[robot] for column in (robots.camera_height_m, robots.base_height_m, robots.arm_reach_m)
        )
        margin_m = around.clearance_m(mount_m, camera_m, radius_m, self._params.mast_radius_m)
        if self._params.within == "clear":
            return margin_m
        if self._reach is None:
            return np.minimum(margin_m, reach_m - _distances(self.xy_m[rows], mount_m, self._target_m)[1])
        x, y = (self._target_m[:2] - self.xy_m[rows]).T
        if not exact:
            return np.minimum(margin_m, (self._reach.farthest_m - np.hypot(x, y)).astype(np.float32))
        turn = self.yaw_rad[rows].astype(np.float64)
        c, s, rise_m = np.cos(turn), np.sin(turn), np.full(len(rows), self._target_m[2] - float(mount_m))
        is_held = self._reach.holds(np.column_stack([c * x + s * y, c * y - s * x, rise_m]))
        return np.where(is_held, margin_m, np.float32(-np.inf))

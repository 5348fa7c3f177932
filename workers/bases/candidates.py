"""Sample base positions around the target and their robots (GBPP, Sec. IV-A)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from datagen.schemas.specification import CandidateParams, Range
from datagen.workers.bases.clearance import Obstacles, base_clearance_m
from datagen.workers.geometry.mesh import F32, F64

Bools = npt.NDArray[np.bool_]

# Rounds over all cells, each with new jitter, before a scene is rejected.
_ROUNDS = 8


@dataclass(frozen=True, eq=False)
class SceneCandidates:
    """N base poses of one scene. Numbers are float32, as stored, so that labels can be recomputed."""

    base_xy_m: F32  # (N, 2), world
    robot_index: npt.NDArray[np.int16]  # (N,)
    camera_height_m: F32  # (N,)
    base_height_m: F32  # (N,)
    arm_reach_m: F32  # (N,)
    clearance_m: F32  # (N,), free distance around the robot's body; below 0 it does not fit

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


def grid_offsets(params: CandidateParams) -> F64:
    """Cell centres (cells^2, 2) of the square grid around the target, row by row from -x, -y.

    The outermost centres lie on the border, so that the grid spans +-grid_half_width_m.
    """
    axis = np.linspace(-params.grid_half_width_m, params.grid_half_width_m, params.grid_cells)
    y, x = np.meshgrid(axis, axis, indexing="ij")
    return np.stack([x.ravel(), y.ravel()], axis=1)


def draw_candidates(
    target_center_m: F64, obstacles: Obstacles, params: CandidateParams, rng: np.random.Generator
) -> SceneCandidates | None:
    """Return all cells of the grid, or `per_scene` positions jittered within cells, with their robots.

    Cells are sampled from all without repetition, or from the set `within`. Candidates are assigned in turn
    to `robots_per_scene` robots, so that a model encodes a scene once per robot; or each has its own robot,
    as in the paper. None where too few cells are in the set for these robots.
    """
    n = params.count
    n_robots = n if params.robot_per_candidate else min(params.robots_per_scene, n)
    robot_index = (np.arange(n) % n_robots).astype(np.int16)
    if params.within is None:
        base_xy_m = (target_center_m[:2] + _offsets(params, rng)).astype(np.float32)
        robots = _draw_robots(params, n_robots, rng)
    else:
        robots = _draw_robots(params, n_robots, rng)
        base_xy_m = _places_within(target_center_m, obstacles, params, robots, robot_index, rng)
        if base_xy_m is None:
            return None
    return _stand(base_xy_m, robot_index, robots, obstacles, params)


def distances(candidates: SceneCandidates, target_center_m: F64) -> tuple[F32, F32]:
    """Horizontal distance base to target centre, and distance arm mount to target centre; each (N,)."""
    planar_m = np.linalg.norm(candidates.base_xy_m.astype(np.float64) - target_center_m[:2], axis=1)
    rise_m = target_center_m[2] - candidates.base_height_m.astype(np.float64)
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


def _stand(
    base_xy_m: F32,
    robot_index: npt.NDArray[np.int16],
    robots: _SceneRobots,
    obstacles: Obstacles,
    params: CandidateParams,
) -> SceneCandidates:
    """SceneCandidates of robots at positions (N, 2), world, with their clearance."""
    camera_m, base_m = robots.camera_height_m[robot_index], robots.base_height_m[robot_index]
    clearance_m = base_clearance_m(base_xy_m, base_m, camera_m, obstacles, params)
    reach_m = robots.arm_reach_m[robot_index]
    return SceneCandidates(base_xy_m, robot_index, camera_m, base_m, reach_m, clearance_m)


def _places_within(
    target_center_m: F64,
    obstacles: Obstacles,
    params: CandidateParams,
    robots: _SceneRobots,
    robot_index: npt.NDArray[np.int16],
    rng: np.random.Generator,
) -> F32 | None:
    """Positions (N, 2), world, in the required set for each candidate's robot; None where too few exist.

    A round visits every cell in random order and uses each at most once; further rounds follow only where one
    does not give enough.
    """
    cells = grid_offsets(params)
    base_xy_m = np.empty((len(robot_index), 2), np.float32)
    open_ = np.ones(len(robot_index), np.bool_)
    for _ in range(_ROUNDS):
        order = rng.permutation(len(cells))
        places_m = (target_center_m[:2] + _jittered(cells[order], params, rng)).astype(np.float32)
        free = np.ones(len(cells), np.bool_)
        for robot in range(len(robots)):
            wanted = np.flatnonzero(open_ & (robot_index == robot))
            if not len(wanted):
                continue
            standing = _stand(places_m, np.full(len(cells), robot, np.int16), robots, obstacles, params)
            found = np.flatnonzero(free & _is_within(standing, target_center_m, params))[: len(wanted)]
            base_xy_m[wanted[: len(found)]] = places_m[found]
            open_[wanted[: len(found)]] = False
            free[found] = False
        if not open_.any():
            return base_xy_m
    return None


def _is_within(candidates: SceneCandidates, target_center_m: F64, params: CandidateParams) -> Bools:
    """Mask (N,) of the candidates in the set `params.within`."""
    clear = candidates.clearance_m >= 0
    if params.within == "clear":
        return clear
    return clear & (distances(candidates, target_center_m)[1] <= candidates.arm_reach_m)

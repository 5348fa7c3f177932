"""Base positions around the target, and whether they are clear, blocked or unseen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from datagen.schemas.specification import CandidateParams
from datagen.train.inputs import F32, F64, I64, Bools
from datagen.train.prediction.fusing import SeenPoints
from datagen.train.prediction.ground import depth_error_m, floor_points
from datagen.workers.bases.candidates import grid_offsets
from datagen.workers.bases.clearance import STEP_M

CLEAR, BLOCKED, UNSEEN = STATES = ("clear", "blocked", "unseen")
# Share of the floor under a base that must have been seen for the base to be clear.
SEEN_SHARE = 0.8
# One stray pixel of a stereo camera is no obstacle.
_LEAST_POINTS = 3
_CELL_M = 0.04
_GAP_CELLS = 4  # gaps up to twice as wide are closed
# Table tops and shelves reach down below the top that is seen of them, by about so much.
_BOARD_M = 0.08
_AROUND_M = 3.0  # farther from the grid's middle nothing matters


@dataclass(frozen=True)
class RobotSize:
    """The robot whose base is looked for; heights above the floor."""

    camera_height_m: float
    base_height_m: float
    arm_reach_m: float

    @property
    def base_radius_m(self) -> float:
        """The radius that the base of such an arm has in runs."""
        return float(CandidateParams(scaled_base=True).radius_of_base_m(self.arm_reach_m))


@dataclass(frozen=True, eq=False)
class BaseCells:
    """N base positions around the target, with what stands there."""

    offset_m: F32  # (N, 2), from the target's centre, world axes
    state: I64  # (N,), index into STATES
    floor_seen: F64  # (N,), share of the floor under the base that was seen


def observe_cells(seen: SeenPoints, center_m: F64, robot: RobotSize, params: CandidateParams) -> BaseCells:
    """The grid around the target, each cell blocked, clear or unseen.

    Blocked where observed points lie within the base's radius between the floor and a board's thickness
    above the mount, or within the mast's from there to the camera; otherwise unseen where too little of its
    floor was seen.
    """
    offsets = grid_offsets(params)
    base_xy = center_m[:2] + offsets
    z = seen.points_m[:, 2]
    gap_m = np.min([np.linalg.norm(seen.points_m - eye, axis=1) for eye in seen.eyes_m], axis=0)
    is_floor = np.any([floor_points(seen.points_m, eye) for eye in seen.eyes_m], axis=0)
    above = (z > STEP_M + 2 * depth_error_m(gap_m)) & ~is_floor
    mount, top = robot.base_height_m, max(robot.camera_height_m, robot.base_height_m)
    low = _counts(seen.points_m[above & (z < mount + _BOARD_M)], base_xy, robot.base_radius_m)
    tops = seen.points_m[above & (z >= mount) & (z < top)]
    high = _counts(tops, base_xy, params.mast_radius_m)
    blocked = (low >= _LEAST_POINTS) | (high >= _LEAST_POINTS) | _in_shadow(tops, base_xy)
    share = _floor_share(seen.points_m[is_floor], base_xy, robot.base_radius_m)
    state = np.where(blocked, STATES.index(BLOCKED), STATES.index(UNSEEN))
    state[~blocked & (share >= SEEN_SHARE)] = STATES.index(CLEAR)
    return BaseCells(offsets.astype(np.float32), state, share)


def seen_share(cloud_m: F32, radius_m: float) -> float:
    """Share of the disc around the target, from above, with a point of the cloud (N, 3, target frame)."""
    n, cell_m = int(np.ceil(radius_m / 0.05)), 0.05
    hit = _occupied(cloud_m, np.full(2, -n * cell_m), cell_m, (2 * n, 2 * n))
    centres = (np.arange(2 * n) + 0.5 - n) * cell_m
    return float(hit[np.hypot(*np.meshgrid(centres, centres)) <= radius_m].mean())


def _counts(points_m: F32, base_xy: F64, radius_m: float) -> I64:
    """Points (N, 3) within the radius of each base, seen from above."""
    near = np.linalg.norm(points_m[:, :2] - base_xy.mean(axis=0), axis=1) < _AROUND_M
    if not near.any():
        return np.zeros(len(base_xy), np.int64)
    counts = KDTree(points_m[near, :2]).query_ball_point(base_xy, radius_m, return_length=True)
    return np.asarray(counts, np.int64)


def _occupied(points_m: F32, low: F64, cell_m: float, size: tuple[int, int]) -> Bools:
    """Cells (size) of a grid on the floor, from corner `low` (2,), with a point (N, 3) above or in them."""
    cells = np.floor((points_m[:, :2] - low) / cell_m).astype(np.int64)
    cells = cells[((cells >= 0) & (cells < size)).all(axis=1)]
    hit = np.zeros(size, np.bool_)
    hit[cells[:, 0], cells[:, 1]] = True
    return hit


def _in_shadow(tops_m: F32, base_xy: F64) -> Bools:
    """Bases (N,) in a gap of a surface above the mount: the object that casts the gap is there."""
    n = int(2 * _AROUND_M / _CELL_M)
    low = base_xy.mean(axis=0) - _AROUND_M
    closed = ndimage.binary_closing(_occupied(tops_m, low, _CELL_M, (n, n)), iterations=_GAP_CELLS)
    rows = np.clip(np.floor((base_xy - low) / _CELL_M).astype(np.int64), 0, n - 1)
    return np.asarray(closed, np.bool_)[rows[:, 0], rows[:, 1]]


def _floor_share(floor_m: F32, base_xy: F64, radius_m: float) -> F64:
    """Share (N,) of the cells under each base in which floor was seen."""
    low = base_xy.min(axis=0) - radius_m - _CELL_M
    size = np.ceil((base_xy.max(axis=0) + radius_m + _CELL_M - low) / _CELL_M).astype(np.int64) + 1
    seen = _occupied(floor_m, low, _CELL_M, (int(size[0]), int(size[1])))
    # Far away, rows of pixels are farther apart than cells are wide.
    seen |= np.asarray(ndimage.binary_closing(seen), np.bool_)
    n = int(np.ceil(radius_m / _CELL_M))
    step = (np.arange(-n, n + 1)) * _CELL_M
    disc = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    disc = disc[np.linalg.norm(disc, axis=1) <= radius_m]
    rows = np.floor((base_xy[:, None] + disc - low) / _CELL_M).astype(np.int64)  # (N, D, 2)
    rows = np.clip(rows, 0, size - 1)
    return seen[rows[..., 0], rows[..., 1]].mean(axis=1)

"""Base positions around the target, and whether they are clear, blocked, unseen or unreachable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from datagen.schemas.fields import facing_rad
from datagen.schemas.specification import CandidateParams
from datagen.train.arrivals import Arrival, expected_success, normal_arrival, stands, tolerance_m
from datagen.train.inputs import F32, F64, I64, Bools
from datagen.train.prediction.floor_ways import CELL_M, WAYS, counted, draw_map, map_corners, ways_to
from datagen.train.prediction.footprints import Footprint
from datagen.train.prediction.fusing import SeenPoints
from datagen.train.prediction.ground import depth_error_m, distances_m, floor_points
from datagen.train.prediction.occupancy import KnownFloor
from datagen.workers.bases.candidates import grid_offsets
from datagen.workers.bases.clearance import STEP_M

CLEAR, BLOCKED, UNSEEN, UNREACHABLE = STATES = ("clear", "blocked", "unseen", "unreachable")
# Share of the floor under a base that must have been seen for the base to be clear.
SEEN_SHARE = 0.8
# One stray pixel of a stereo camera is no obstacle.
_LEAST_POINTS = 3
_GAP_CELLS = 4  # gaps up to twice as wide are closed
# Boards of tables and shelves reach about this far below their visible top.
_BOARD_M = 0.08
_AROUND_M = 3.0  # from the grid's middle; farther points are ignored
_THIN_M = 0.01  # points of obstacles are counted in cells of this side
_STOPS = normal_arrival(0.02)  # around its goal, a robot that arrives well


@dataclass(frozen=True)
class RobotSize:
    """The robot to place; heights above the floor."""

    camera_height_m: float
    base_height_m: float
    arm_reach_m: float
    footprint: Footprint | None = None  # None: the circular base of such an arm in runs
    yaw_rad: float = 0.0  # heading of the base relative to the direction to the target
    name: str = ""  # as `open_robot` accepts it; "" for an unknown robot

    @property
    def outline(self) -> Footprint:
        """Outline of the base around the mount (m)."""
        if self.footprint is not None:
            return self.footprint
        return Footprint(float(CandidateParams(scaled_base=True).radius_of_base_m(self.arm_reach_m)))


@dataclass(frozen=True, eq=False)
class BaseCells:
    """N base positions around the target, with their states."""

    offset_m: F32  # (N, 2), from the target's centre, world axes
    state: I64  # (N,), index into STATES


def headings(offset_m: F32, robot: RobotSize) -> F64:
    """Headings (N,) of a robot at offsets (N, 2) from the target, counter-clockwise from x."""
    yaw_rad = facing_rad(-offset_m.astype(np.float64))
    return (yaw_rad + robot.yaw_rad + np.pi) % (2 * np.pi) - np.pi if robot.yaw_rad else yaw_rad


def within_reach(offset_m: F32, height_m: float, robot: RobotSize) -> Bools:
    """Mask (N,) of bases at offsets (N, 2) from the target whose arm reaches to its centre at `height_m`."""
    far_m = np.hypot(np.linalg.norm(offset_m, axis=1), height_m - robot.base_height_m)
    return far_m <= robot.arm_reach_m


def observe_cells(
    seen: SeenPoints,
    center_m: F64,
    robot: RobotSize,
    params: CandidateParams,
    yaw_error_rad: float = 0.0,
    known: KnownFloor | None = None,
) -> BaseCells:
    """The grid around the target, each cell blocked, unreachable, unseen or clear, in this order.

    A cell is blocked where observed points lie in the base's outline between the floor and a board's
    thickness above the mount, or within the mast's radius from there to the camera. It is unreachable where
    no way leads there (`floor_ways`), and unseen where too little of the floor below it, or of the way, was
    seen. A polygon must also fit where the base turns up to twice `yaw_error_rad` too far. Floor that is
    `known` to be free counts as seen, and occupied floor as points there.
    """
    offsets, base = grid_offsets(params), robot.outline
    base_xy, yaw = center_m[:2] + offsets, headings(offsets.astype(np.float32), robot)
    z = seen.points_m[:, 2]
    gap_m = np.minimum.reduce([distances_m(seen.points_m, eye) for eye in seen.eyes_m])
    is_floor = np.logical_or.reduce([floor_points(seen.points_m, eye) for eye in seen.eyes_m])
    above = (z > STEP_M + 2 * depth_error_m(gap_m)) & ~is_floor
    mount, top = robot.base_height_m, max(robot.camera_height_m, robot.base_height_m)
    low_points = seen.points_m[above & (z < mount + _BOARD_M)]
    tops = seen.points_m[above & (z >= mount) & (z < top)]
    floor = seen.points_m[is_floor]
    if known is not None:
        around = map_corners(base_xy, seen.eyes_m)
        free, occupied = (np.insert(xy, 2, 0.0, axis=1).astype(np.float32) for xy in known.points(*around))
        low_points, floor = np.concatenate([low_points, occupied]), np.concatenate([floor, free])
    high = crowded_bases(tops, base_xy, yaw, Footprint(params.mast_radius_m))
    turns = (-2 * yaw_error_rad, 0.0, 2 * yaw_error_rad) if yaw_error_rad and base.corners_m else (0.0,)
    low = np.any([crowded_bases(low_points, base_xy, yaw + turn, base) for turn in turns], axis=0)
    blocked = low | high | _in_shadow(tops, base_xy)
    share = _floor_share(floor, base_xy, yaw, base)
    way = ways_to(
        draw_map(base_xy, seen.eyes_m, low_points, tops, floor),
        base_xy + _turned(np.broadcast_to(base.middle_m, (1, 2)), yaw)[:, 0],
        base.turning_radius_m - base.width_m,
        base.turning_radius_m,
        params.mast_radius_m,
        seen.points_m,
        seen.eyes_m,
    )
    state = np.full(len(base_xy), STATES.index(UNSEEN))
    state[(share >= SEEN_SHARE) & (way == WAYS.index("seen"))] = STATES.index(CLEAR)
    state[way == WAYS.index("none")] = STATES.index(UNREACHABLE)
    state[blocked] = STATES.index(BLOCKED)
    return BaseCells(offsets.astype(np.float32), state)


def seen_share(cloud_m: F32, radius_m: float) -> float:
    """Share of the disc around the target, from above, with a point of the cloud (N, 3, target frame)."""
    n, cell_m = int(np.ceil(radius_m / 0.05)), 0.05
    hit = counted(cloud_m, np.full(2, -n * cell_m), cell_m, (2 * n, 2 * n)) > 0
    centres = (np.arange(2 * n) + 0.5 - n) * cell_m
    return float(hit[np.hypot(*np.meshgrid(centres, centres)) <= radius_m].mean())


def crowded_bases(points_m: F32, base_xy: F64, yaw: F64, base: Footprint) -> Bools:
    """Mask (N,) of bases that have `_LEAST_POINTS` points (N, 3) in their outline, seen from above."""
    low = base_xy.mean(axis=0) - _AROUND_M
    n = int(np.ceil(2 * _AROUND_M / _THIN_M))
    counts = counted(points_m, low, _THIN_M, (n, n)).ravel()
    cells = np.flatnonzero(counts)
    if not len(cells):
        return np.zeros(len(base_xy), np.bool_)
    thin, weight = low + _THIN_M * (np.column_stack(np.divmod(cells, n)) + 0.5), counts[cells]
    tree = KDTree(thin, compact_nodes=False, balanced_tree=False)  # built faster
    # Every outline holds this circle: few bases are left whose points must be counted one by one.
    crowded = tree.query_ball_point(base_xy, base.inner_radius_m, return_length=True) >= _LEAST_POINTS
    left = np.flatnonzero(~crowded)
    found = tree.query_ball_point(base_xy[left], base.radius_m)
    row = np.repeat(left, [len(rows) for rows in found])
    point = np.concatenate([*found, np.empty(0)]).astype(np.int64)
    if base.corners_m:
        rel, c, s = thin[point] - base_xy[row], np.cos(yaw[row]), np.sin(yaw[row])
        # Most points are in many outlines: all pairs are tested at once.
        inside = base.holds(np.column_stack([c * rel[:, 0] + s * rel[:, 1], c * rel[:, 1] - s * rel[:, 0]]))
        row, point = row[inside], point[inside]
    return crowded | (np.bincount(row, weight[point], len(base_xy)) >= _LEAST_POINTS)


def _turned(points_m: F64, yaw: F64) -> F64:
    """Points (D, 2) of the base frame at each heading (N,), as (N, D, 2) from the base, world axes."""
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x, y = points_m.T
    return np.stack([c * x - s * y, s * x + c * y], axis=2)


def _in_shadow(tops_m: F32, base_xy: F64) -> Bools:
    """Mask (N,) of bases in a gap of a surface above the mount: an object there hides the surface."""
    n = int(2 * _AROUND_M / CELL_M)
    low = base_xy.mean(axis=0) - _AROUND_M
    closed = ndimage.binary_closing(counted(tops_m, low, CELL_M, (n, n)) > 0, iterations=_GAP_CELLS)
    rows = np.clip(np.floor((base_xy - low) / CELL_M).astype(np.int64), 0, n - 1)
    return np.asarray(closed, np.bool_)[rows[:, 0], rows[:, 1]]


def _floor_share(floor_m: F32, base_xy: F64, yaw: F64, base: Footprint) -> F64:
    """Share (N,) of the cells under each base in which floor was seen."""
    low = base_xy.min(axis=0) - base.radius_m - CELL_M
    size = np.ceil((base_xy.max(axis=0) + base.radius_m + CELL_M - low) / CELL_M).astype(np.int64) + 1
    seen = counted(floor_m, low, CELL_M, (int(size[0]), int(size[1]))) > 0
    # Far away, rows of pixels are farther apart than cells are wide.
    seen |= np.asarray(ndimage.binary_closing(seen), np.bool_)
    n = int(np.ceil(base.radius_m / CELL_M))
    step = np.arange(-n, n + 1) * CELL_M
    under: F64 = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2).astype(np.float64)
    under = under[base.holds(under)]
    below = _turned(under, yaw) if base.corners_m else under  # a circle is the same at every heading
    rows = np.floor((base_xy[:, None] + below - low) / CELL_M).astype(np.int64)  # (N, D, 2)
    rows = np.clip(rows, 0, size - 1)
    return seen[rows[..., 0], rows[..., 1]].mean(axis=1)


@dataclass(frozen=True, eq=False)
class Choice:
    """The chosen base pose, as a row of the cells; None where none may be chosen or none scores well."""

    best: int | None
    nominal: int | None  # the row with the best score
    expected: F64 | None  # (N,) success expected with the arrival error; None without one
    miss_m: float | None  # distance by which the robot may miss the best while scores stay good
    can_stand: Bools  # (N,) whether a pose may be chosen
    ranked: I64  # (K,) rows of those with a good score, best first


def choose(
    score: F64,
    cells: BaseCells,
    allowed: Sequence[str],
    threshold: float,
    arrival: Arrival | None,
    alike: float = 0.0,
) -> Choice:
    """The best of the cells in an `allowed` state; with an arrival error by the mean score on arrival.

    A robot that arrives where a base is in another state fails. Scores from `threshold` on are good: where no
    pose has one, none is best. Without a threshold (nan) there is no `miss_m`. Of scores that are `alike`, by
    how much they differ from the best, the one with the most room for a robot that stops well is taken.
    """
    can_stand = np.isin(cells.state, [STATES.index(name) for name in allowed])
    rows = np.flatnonzero(can_stand)
    if not len(rows):
        return Choice(None, None, None, None, can_stand, rows)
    nominal = int(rows[np.argmax(score[rows])])
    if score[nominal] < threshold:
        return Choice(None, nominal, None, None, can_stand, rows[:0])
    side = round(float(np.sqrt(len(score))))
    step_m = float(np.ptp(cells.offset_m[:, 0]) / (side - 1))
    value, is_good = stands(score, can_stand).reshape(side, side), can_stand & ~(score < threshold)
    good = np.flatnonzero(is_good)
    if arrival is None:
        expected, near = None, good[score[good] >= score[nominal] - alike]
        room = expected_success(is_good.astype(np.float64).reshape(side, side), step_m, _STOPS).ravel()
        best = int(near[np.lexsort([-score[near], -room[near]])[0]])
    else:
        expected = expected_success(value, step_m, arrival).ravel()
        best = int(rows[np.argmax(expected[rows])])
    ranked = good[np.argsort(-(score if expected is None else expected)[good], kind="stable")]
    miss_m = None if np.isnan(threshold) else tolerance_m(value, step_m, divmod(best, side), threshold)
    return Choice(best, nominal, expected, miss_m, can_stand, ranked)

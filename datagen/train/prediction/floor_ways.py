"""Whether a base can drive from the camera to a base pose, over floor that was seen or may be free.

A map of the floor in square cells. The way is looked for with the base as a circle that can turn on the spot.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from datagen.train.inputs import F32, F64, I64, Bools

CELL_M = 0.04
# How a base gets there: over floor that was seen, over floor of which some is out of sight, or not at all.
WAYS = ("seen", "unseen", "none")
_MARGIN_M = 2.5  # margin of the map around base poses, for ways around obstacles
_EYE_M = 6.0  # a camera farther from the target than this is outside the map
_BEARINGS = 360  # directions around a camera
_SIGHT_POINTS = 60_000  # points used for all bearings
# Number of points at either end of a bearing that may be stray.
_STRAY = 3
# The end of sight along a bearing is a wall if it rises by this within the depth, or above the camera.
_RISE_M, _DEPTH_M = 0.3, 0.15
_SMOOTH = 9  # bearings of which most must end at a wall, unlike at a bottle before the image's edge
_BEHIND_M = 0.1
_BLIND_M, _STEPS = 2.0, 2  # from a camera to the first floor that it sees; cells per step
# Share of the floor below a base that must be known on the way: half, as at the edge of an image.
_LEAST_KNOWN = 0.5
_LEAST_PATCH = 25  # cells of floor, 0.04 m2, from which ways may begin


@dataclass(frozen=True, eq=False)
class FloorMap:
    """Observed obstacles and floor on a grid of X x Y cells with its corner at `low_m`, world."""

    low_m: F64  # (2,)
    low_obstacle: Bools  # (X, Y), in the way of the base
    mast_obstacle: Bools  # (X, Y), in the way of the mast
    floor: Bools  # (X, Y), floor was seen

    def rows(self, xy_m: F64) -> tuple[I64, I64]:
        """Cells of positions (N, 2), those outside at the border."""
        cells = np.floor((xy_m - self.low_m) / CELL_M).astype(np.int64)
        x, y = np.clip(cells, 0, np.array(self.floor.shape) - 1).T
        return x, y

    def centres(self) -> F64:
        """Positions (X, Y, 2) of the cells' middles."""
        x, y = (
            low + CELL_M * (np.arange(n) + 0.5) for low, n in zip(self.low_m, self.floor.shape, strict=True)
        )
        return np.stack(np.meshgrid(x, y, indexing="ij"), axis=2)


def draw_map(base_xy_m: F64, eyes_m: F64, low_points_m: F32, mast_points_m: F32, floor_m: F32) -> FloorMap:
    """The map around base positions (N, 2) and cameras (F, 3), world.

    Points (M, 3) are those of obstacles below the mount, of obstacles above it, and of floor.
    """
    low, high = map_corners(base_xy_m, eyes_m)
    size = (int(np.ceil((high[0] - low[0]) / CELL_M)), int(np.ceil((high[1] - low[1]) / CELL_M)))
    # Far away, rows of pixels are farther apart than cells are wide.
    floor = ndimage.binary_closing(counted(floor_m, low, CELL_M, size) > 0)
    return FloorMap(
        low,
        _crowded(low_points_m, low, size),
        _crowded(mast_points_m, low, size),
        np.asarray(floor, np.bool_),
    )


def map_corners(base_xy_m: F64, eyes_m: F64) -> tuple[F64, F64]:
    """The corners (2,) of the map around base positions (N, 2) and cameras (F, 3)."""
    middle = base_xy_m.mean(axis=0)
    near = eyes_m[np.linalg.norm(eyes_m[:, :2] - middle, axis=1) < _EYE_M, :2]
    around = np.concatenate([base_xy_m, near])
    return around.min(axis=0) - _MARGIN_M, around.max(axis=0) + _MARGIN_M


def ways_to(
    floor_map: FloorMap,
    goals_m: F64,
    slack_m: float,
    radius_m: float,
    mast_radius_m: float,
    points_m: F32,
    eyes_m: F64,
) -> I64:
    """Index (N,) into `WAYS` for a circular base of `radius_m` from the cameras to each middle (N, 2).

    A base that is narrower than its circle may end up to `slack_m` off a way. `points_m` (M, 3) are all
    observed points. No way leads through cells behind a wall as seen from all cameras (F, 3).
    """
    near, ends = _sights(points_m, eyes_m)
    hidden = _hidden(floor_map, ends, eyes_m)
    fits = (_distance_m(floor_map.low_obstacle) >= radius_m) & ~hidden
    fits &= _distance_m(floor_map.mast_obstacle) >= mast_radius_m
    seen = _share(floor_map.floor, radius_m) >= _LEAST_KNOWN
    known = _share(floor_map.floor | _blind(floor_map, near, eyes_m, radius_m), radius_m) >= _LEAST_KNOWN
    open_ways, seen_ways = _reached(fits, fits & (known | seen), fits & seen, floor_map.rows(eyes_m[:, :2]))
    way = np.full(len(goals_m), WAYS.index("none"))
    at = floor_map.rows(goals_m)
    # A cell's middle is up to 0.7 of its side from a base's.
    way[(_distance_m(open_ways)[at] <= slack_m + CELL_M) & ~hidden[at]] = WAYS.index("unseen")
    way[(_distance_m(seen_ways)[at] <= slack_m + CELL_M) & ~hidden[at]] = WAYS.index("seen")
    return way


def counted(points_m: F32 | F64, low: F64, cell_m: float, size: tuple[int, int]) -> I64:
    """Number of points (N, 2 or more) in each cell (size) of a floor grid with its corner at `low` (2,)."""
    # By columns: reductions along short rows cost more than all else here.
    x, y = (np.floor((points_m[:, k] - low[k]) / cell_m).astype(np.int64) for k in range(2))
    inside = (x >= 0) & (x < size[0]) & (y >= 0) & (y < size[1])
    return np.bincount((x * size[1] + y)[inside], minlength=size[0] * size[1]).reshape(size)


def _crowded(points_m: F32, low: F64, size: tuple[int, int]) -> Bools:
    """Cells (size) with a point, and `_STRAY` in their neighbourhood: one stray pixel is no obstacle."""
    counts = counted(points_m, low, CELL_M, size)
    around = ndimage.convolve(counts, np.ones((3, 3), np.int64), mode="constant")
    return (counts > 0) & (around >= _STRAY)


def _distance_m(obstacle: Bools) -> F64:
    if not obstacle.any():
        return np.full(obstacle.shape, np.inf)
    return np.asarray(ndimage.distance_transform_edt(~obstacle, sampling=CELL_M), np.float64)


def _share(known: Bools, radius_m: float) -> F64:
    """Share of known cells in the disc around each cell, by sums along its rows."""
    n = int(np.ceil(radius_m / CELL_M))
    sums = np.cumsum(np.pad(known, ((n, n), (n + 1, n))), axis=1, dtype=np.int64)
    total, area = np.zeros(known.shape, np.int64), 0
    for dx in range(-n, n + 1):
        half = np.sqrt(max(radius_m**2 - (dx * CELL_M) ** 2, 0.0)) / CELL_M
        k, rows = int(half), sums[n + dx : n + dx + known.shape[0]]
        if abs(dx) * CELL_M > radius_m:
            continue
        ahead = rows[:, n + k + 1 : n + k + 1 + known.shape[1]]
        total += ahead - rows[:, n - k : n - k + known.shape[1]]
        area += 2 * k + 1
    return total / area


@dataclass(frozen=True, eq=False)
class _Ends:
    """Ends of sight along each bearing of one camera."""

    far_m: F64  # (_BEARINGS,) distance on the floor to the farthest point; 0 without points
    is_wall: Bools  # (_BEARINGS,)


def _sights(points_m: F32, eyes_m: F64) -> tuple[list[F64], list[_Ends]]:
    """For each camera: floor distance to the nearest point along each bearing (_BEARINGS,), and its ends."""
    nearest, ends = list[F64](), list[_Ends]()
    points_m = points_m[:: max(1, len(points_m) // _SIGHT_POINTS)]
    for eye in eyes_m:
        rel = points_m[:, :2] - eye[:2].astype(np.float32)
        gap = np.hypot(rel[:, 0], rel[:, 1])
        bearing = _bearing(rel)
        order = np.argsort(bearing * 1024.0 + gap)  # by bearing, then by distance
        bearing, gap, z = bearing[order], gap[order], points_m[order, 2]
        first = np.searchsorted(bearing, np.arange(_BEARINGS + 1))
        near, far, wall = np.zeros(_BEARINGS), np.zeros(_BEARINGS), np.zeros(_BEARINGS, np.bool_)
        for k in np.flatnonzero(np.diff(first) > 2 * _STRAY):
            a, b = first[k], first[k + 1]
            near[k], far[k] = gap[a + _STRAY], gap[b - _STRAY]
            last = z[a + np.searchsorted(gap[a:b], far[k] - _DEPTH_M) : b]
            wall[k] = last.max() >= eye[2] or np.ptp(last) >= _RISE_M
        known = ndimage.uniform_filter1d((far > 0).astype(np.float64), _SMOOTH, mode="wrap")
        walls = ndimage.uniform_filter1d(wall.astype(np.float64), _SMOOTH, mode="wrap")
        nearest.append(near)
        ends.append(_Ends(far, wall & (walls > known / 2)))
    return nearest, ends


def _bearing(rel_m: F32 | F64) -> I64:
    """Bearing (...) of directions (..., 2), as a number below `_BEARINGS`."""
    angle = np.arctan2(rel_m[..., 1], rel_m[..., 0])
    return np.floor((angle / (2 * np.pi) + 0.5) * _BEARINGS).astype(np.int64) % _BEARINGS


def _hidden(floor_map: FloorMap, ends: list[_Ends], eyes_m: F64) -> Bools:
    """Cells (X, Y) behind a wall for a camera, out of sight of the others, and without observed floor."""
    behind, beyond = np.zeros(floor_map.floor.shape, np.bool_), np.zeros(floor_map.floor.shape, np.bool_)
    for eye, end in zip(eyes_m, ends, strict=True):
        rel = floor_map.centres() - eye[:2]
        gap, k = np.hypot(rel[..., 0], rel[..., 1]), _bearing(rel)
        is_behind = end.is_wall[k] & (gap > end.far_m[k] + _BEHIND_M)
        behind |= is_behind
        beyond |= (end.far_m[k] > 0) & ~is_behind
    return behind & ~beyond & ~floor_map.floor


def _blind(floor_map: FloorMap, near: list[F64], eyes_m: F64, radius_m: float) -> Bools:
    """Cells (X, Y) below the image of a camera: around it, and up to the nearest point of each bearing.

    They count as free on the way: the robot that took the frame stood there.
    """
    blind = np.zeros(floor_map.floor.shape, np.bool_)
    for eye, near_m in zip(eyes_m, near, strict=True):
        rel = floor_map.centres() - eye[:2]
        gap = np.hypot(rel[..., 0], rel[..., 1])
        blind |= gap < np.maximum(near_m[_bearing(rel)], 2 * radius_m)
    return blind


def _reached(fits: Bools, known: Bools, seen: Bools, starts: tuple[I64, I64]) -> tuple[Bools, Bools]:
    """Cells connected with the starts over `fits`, and cells connected over `known`, a part of `fits`.

    A start that does not fit moves to the nearest cell that does. Known ways also begin at the nearest `seen`
    floor on the way, within `_BLIND_M`: no camera sees the floor before it.
    """
    begins = np.zeros_like(fits)
    if not fits.any():
        return begins, begins
    nearest = np.asarray(ndimage.distance_transform_edt(~fits, return_distances=False, return_indices=True))
    patch = np.zeros(fits.shape, np.int64)
    ndimage.label(seen, output=patch)
    seen = seen & (np.bincount(patch.ravel())[patch] >= _LEAST_PATCH)
    known_begins, around = np.zeros_like(fits), np.ones((3, 3), np.bool_)
    for x, y in np.unique(nearest[:, starts[0], starts[1]].T, axis=0):
        begins[x, y] = True
        known_begins[x, y] = known[x, y]
        front = np.zeros_like(fits)
        front[x, y] = True
        for _ in range(int(_BLIND_M / CELL_M / _STEPS)):
            if (front & seen).any():
                break
            front = np.asarray(ndimage.binary_dilation(front, around, _STEPS, fits), np.bool_)
        known_begins |= front & seen
    open_ways = np.asarray(ndimage.binary_propagation(begins, mask=fits), np.bool_)
    return open_ways, np.asarray(ndimage.binary_propagation(known_begins, mask=known), np.bool_)

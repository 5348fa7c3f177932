"""rho as far as the observed cloud tells it: a small z-buffer from each candidate's camera.

The window is that of the true rho (`workers/rendering/visibility.py`): it looks at the target's centre and
touches its bounding sphere. Points are few (of a table about one every 3 cm), so each stands for a disc in
the tangent plane of its neighbours, as large as they are far (surface splatting, Zwicker et al. 2001): a
table seen at a grazing angle stays thin, and does not hide what stands on it.

The target's unobserved back is its observed points taken a second time, turned by half a turn about the
vertical axis through its centre; exact for boxes and for all that is turned on a lathe. Where no point was
seen, nothing hides: neither the backs of other things, nor what is outside the cloud.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from train.inputs import Array, Candidates, Clouds, Robots

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.integer[Any]]

_CELLS = 16  # of a window, each way
_TARGET_POINTS = 128  # that stand for the target's observed side
# A disc reaches about half as far as the eighth neighbour, so that discs just close a surface.
_NEIGHBOURS = 8
_DISC_SHARE = 0.55
_LARGEST_DISC_M = 0.06
_MARGIN_M = 0.02  # a disc hides what lies farther behind it than this
_NEAREST_M = 0.02  # to an eye; points before it are the robot's own
_PAIRS = 1 << 18  # of eye and point at once: bounds memory, and stays in the cache


def observed_visibility(clouds: Clouds[Array], robots: Robots[Array], candidates: Candidates[Array]) -> F64:
    """Estimated rho (N,) in [0, 1] of every candidate, from the points of its robot's cloud alone.

    0 where no point of the target was observed, and where the camera is inside the target's sphere.
    """
    rho = np.zeros(len(candidates))
    cloud_row = robots.cloud_row[candidates.robot_row]
    eyes_m = eyes(clouds, robots, candidates)
    for row in np.unique(cloud_row):
        n = int(clouds.n_points[row])
        points_m, mask = clouds.points_m[row, :n], clouds.target_mask[row, :n]
        rows = np.flatnonzero(cloud_row == row)
        radius_m = float(clouds.target_radius_m[row])
        rho[rows] = visible_share(points_m[~mask], points_m[mask], radius_m, eyes_m[rows])
    return rho


def eyes(clouds: Clouds[Array], robots: Robots[Array], candidates: Candidates[Array]) -> F32:
    """The cameras (N, 3) of the candidates, in their target's frame."""
    robot = candidates.robot_row
    height_m = robots.camera_height_m[robot] - clouds.target_height_m[robots.cloud_row[robot]]
    return np.column_stack([candidates.base_xy_m, height_m]).astype(np.float32)


def visible_share(others_m: F32, target_m: F32, radius_m: float, eyes_m: F32) -> F64:
    """Share (N,) of the target's cells, seen from each eye (N, 3), before which nothing else lies.

    Points of other things (M, 3) and of the target (T, 3), the latter in an order of which any prefix
    covers it, and eyes, all in the target's frame. `radius_m` is that of the sphere that holds the target.
    """
    share = np.zeros(len(eyes_m))
    finite = np.isfinite(target_m).all(1)
    side_m = target_m[finite][:_TARGET_POINTS].astype(np.float32)
    usable = np.flatnonzero(np.linalg.norm(eyes_m, axis=1) > max(1.05 * radius_m, 1e-3))
    if not len(side_m) or not len(usable) or not radius_m > 0:
        return share
    whole_m = np.concatenate([side_m, side_m * np.array([-1, -1, 1], np.float32)])
    others_m = others_m[np.isfinite(others_m).all(1)].astype(np.float32)
    block = max(1, _PAIRS // max(len(others_m), len(whole_m)))
    blocks = [usable[start : start + block] for start in range(0, len(usable), block)]
    views = [Views(eyes_m[rows], radius_m) for rows in blocks]
    near = np.zeros(len(others_m), np.bool_)
    for view in views:
        near |= view.near_line(others_m, _LARGEST_DISC_M).any(0)
    discs = _discs(others_m, near)
    for rows, view in zip(blocks, views, strict=True):
        front_m = _closed(view.nearest_m(whole_m))
        on_target = front_m > -np.inf
        seen = on_target & ~_majority(view.hidden(discs, front_m), on_target)
        share[rows] = seen.sum((1, 2)) / np.maximum(on_target.sum((1, 2)), 1)
    return share


@dataclass(frozen=True, eq=False)
class _Discs:
    """Small pieces of surface around points: where, which way, how large."""

    centre_m: F32  # (M, 3)
    normal: F32  # (M, 3)
    radius_m: F32  # (M,)

    def __len__(self) -> int:
        return len(self.radius_m)


def _discs(points_m: F32, asked: Bools) -> _Discs:
    """A disc for each asked point (M,), in the plane of its neighbours and as large as they are far."""
    if len(points_m) <= _NEIGHBOURS or not asked.any():  # too few to tell a surface
        return _Discs(points_m[:0], points_m[:0], np.zeros(0, np.float32))
    centre_m = points_m[asked]
    distance_m, row = KDTree(points_m).query(centre_m, _NEIGHBOURS + 1)
    around_m = points_m[row]
    around_m = around_m - around_m.mean(1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around_m, around_m))
    radius_m = np.minimum(_DISC_SHARE * distance_m[:, -1], _LARGEST_DISC_M)
    return _Discs(centre_m, axes[:, :, 0].astype(np.float32), radius_m.astype(np.float32))


class Views:
    """Cameras at eyes (N, 3) that look at the origin, each with a square window of cells around it."""

    def __init__(self, eyes_m: F32, radius_m: float) -> None:
        self.distance_m = np.linalg.norm(eyes_m, axis=1)  # (N,)
        self.towards = eyes_m / self.distance_m[:, None]  # (N, 3), from the target to the eye
        right = np.stack([-self.towards[:, 1], self.towards[:, 0], np.zeros_like(self.distance_m)], axis=1)
        length = np.linalg.norm(right, axis=1, keepdims=True)
        self.right = np.where(
            length > 1e-6, right / np.maximum(length, 1e-6), np.array([1, 0, 0], np.float32)
        )
        self.up = np.cross(self.towards, self.right)
        sine = np.minimum(radius_m / self.distance_m, 0.99)
        self.half_m = radius_m / np.sqrt(1 - sine**2)  # (N,), of the window at the target's centre

    def near_line(self, points_m: F32, slack_m: float | F32 = 0.0) -> Bools:
        """Which points (N, M) lie before the eye, in the cone around its window or within slack_m of it."""
        along_m = self.towards @ points_m.T
        across2 = np.einsum("ij,ij->i", points_m, points_m) - along_m * along_m
        ahead_m = self.distance_m[:, None] - along_m
        limit_m = (np.sqrt(2.0, dtype=np.float32) * self.half_m / self.distance_m)[
            :, None
        ] * ahead_m + slack_m
        return (ahead_m > _NEAREST_M) & (across2 <= limit_m * limit_m)

    def nearest_m(self, points_m: F32) -> F32:
        """How far towards the eye the nearest point of each cell (N, cells, cells) is, or -inf."""
        depths = np.full((len(self.distance_m), _CELLS, _CELLS), -np.inf, np.float32)
        eye, point = np.nonzero(self.near_line(points_m))
        x, y, along_m, _ = self._seen(eye, points_m[point])
        column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        inside = (column >= 0) & (column < _CELLS) & (row >= 0) & (row < _CELLS)
        cell = (eye * _CELLS + row) * _CELLS + column
        np.maximum.at(depths.reshape(-1), cell[inside], along_m[inside])
        return depths

    def hidden(self, discs: _Discs, front_m: F32) -> Bools:
        """In which cells (N, cells, cells) a disc lies clearly before what is there at `front_m`."""
        eye, disc = np.nonzero(self.near_line(discs.centre_m, discs.radius_m))
        front = np.where(front_m > -np.inf, front_m, np.inf)
        ahead = (discs.centre_m[disc] * self.towards[eye]).sum(1) + discs.radius_m[disc]
        eye, disc = (a[ahead > front.min((1, 2))[eye] + _MARGIN_M] for a in (eye, disc))
        x, y, along_m, cell_m = self._seen(eye, discs.centre_m[disc])
        normal, radius_m = discs.normal[disc], discs.radius_m[disc]
        pair, column, row = _cells_within(x, y, radius_m / cell_m)
        dx, dy = column + np.float32(0.5) - x[pair], row + np.float32(0.5) - y[pair]
        # The plane's rise towards the eye, by cell; a disc seen from its edge is one cell thick.
        facing = (normal * self.towards[eye]).sum(1)
        facing = np.where(np.abs(facing) < 1e-3, np.float32(1e-3), facing)
        rise_x = -(normal * self.right[eye]).sum(1) / facing * cell_m
        rise_y = -(normal * self.up[eye]).sum(1) / facing * cell_m
        own = (np.abs(dx) <= 0.5) & (np.abs(dy) <= 0.5)
        rise_m = np.where(own, np.float32(0), rise_x[pair] * dx + rise_y[pair] * dy)
        gap2 = (dx * dx + dy * dy) * (cell_m * cell_m)[pair] + rise_m * rise_m
        cell = (eye[pair] * _CELLS + row) * _CELLS + column
        before = along_m[pair] + rise_m > front.reshape(-1)[cell] + _MARGIN_M
        hidden = np.zeros(front.size, np.bool_)
        hidden[cell[before & (own | (gap2 <= (radius_m * radius_m)[pair]))]] = True
        return hidden.reshape(front.shape)

    def _seen(self, eye: Ints, points_m: F32) -> tuple[F32, F32, F32, F32]:
        """Where eyes see points (K, 3): column and row, in cells; metres towards the eye; metres a cell."""
        along_m = (points_m * self.towards[eye]).sum(1)
        per_depth = 2 / _CELLS * self.half_m / self.distance_m
        cell_m = per_depth[eye] * (self.distance_m[eye] - along_m)
        x = (points_m * self.right[eye]).sum(1) / cell_m + _CELLS / 2
        y = (points_m * self.up[eye]).sum(1) / cell_m + _CELLS / 2
        return x, y, along_m, cell_m


def _cells_within(x: F32, y: F32, reach: F32) -> tuple[Ints, Ints, Ints]:
    """Pair, column and row of every cell in the squares of half-width `reach` around x, y (K,), in cells."""
    low = [np.clip(np.floor(c - reach), 0, _CELLS).astype(np.int32) for c in (x, y)]
    high = [np.clip(np.floor(c + reach) + 1, 0, _CELLS).astype(np.int32) for c in (x, y)]
    width, height = high[0] - low[0], high[1] - low[1]
    count = width * height
    pair = np.repeat(np.arange(len(x), dtype=np.int32), count)
    k = np.arange(len(pair), dtype=np.int32) - (np.cumsum(count, dtype=np.int32) - count)[pair]
    down, across = np.divmod(k, width[pair])
    return pair, low[0][pair] + across, low[1][pair] + down


def _closed(depths_m: F32) -> F32:
    """Gaps between points filled from the cells beside them; the outline does not grow."""
    padded = np.pad(depths_m, ((0, 0), (1, 1), (1, 1)), constant_values=-np.inf)
    grown = np.maximum.reduce([padded[:, 1:-1, 1:-1], *_beside(padded)])
    # Cells outside the window hold back nothing: the target may touch its border.
    full = np.pad(grown > -np.inf, ((0, 0), (1, 1), (1, 1)), constant_values=True)
    inside = np.logical_and.reduce([full[:, 1:-1, 1:-1], *_beside(full)])
    return np.where((depths_m > -np.inf) | inside, grown, -np.inf).astype(np.float32)


def _majority(hidden: Bools, on_target: Bools) -> Bools:
    """Hidden where most of the target's cells around a cell are: holes between points close, specks go."""
    counts: list[Array] = []
    for cells in (hidden, on_target):
        padded = np.pad(cells.astype(np.int8), ((0, 0), (1, 1), (1, 1)))
        rows = padded[:, 2:] + padded[:, 1:-1] + padded[:, :-2]
        counts.append(rows[:, :, 2:] + rows[:, :, 1:-1] + rows[:, :, :-2])
    return 2 * counts[0] > counts[1]


def _beside(padded: Array) -> list[Array]:
    return [padded[:, 2:, 1:-1], padded[:, :-2, 1:-1], padded[:, 1:-1, 2:], padded[:, 1:-1, :-2]]

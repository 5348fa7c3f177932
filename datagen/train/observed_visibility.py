"""Estimate rho from the observed cloud: a small z-buffer from each candidate's camera.

The window is that of the true rho (`workers/rendering/visibility.py`): it is centred on the target and
touches its bounding sphere. Points are sparse (on a table about one every 3 cm), so each is a disc in the
tangent plane of its neighbours, sized by their distance (surface splatting, Zwicker et al. 2001): a table
seen at a grazing angle stays thin and does not hide the objects on it.

The target's unobserved back is a copy of its observed points, rotated by 180 degrees about the vertical axis
through its centre; exact for boxes and solids of revolution. Unobserved surfaces hide nothing: neither the
backs of other objects, nor objects outside the cloud.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from datagen.train.inputs import F32, F64, Array, Bools, CandidateInputs, Clouds, Ints, RobotInputs

_CELLS = 16  # cells along each side of a window
_TARGET_POINTS = 128  # points that stand for the target's observed side
# A disc reaches about half as far as the eighth neighbour, so that discs just close a surface.
_NEIGHBOURS = 8
_DISC_SHARE = 0.55
_LARGEST_DISC_M = 0.06
_MARGIN_M = 0.02  # a disc hides points that are farther behind it than this
_NEAREST_M = 0.02  # distance from an eye; nearer points are the robot's own
_EYES_AT_ONCE = 48  # eyes tested together, on one sector of points
_AT_ONCE = 1 << 16  # pairs of eye and point: bounds memory, and fits in the cache


def observed_visibility(
    clouds: Clouds[Array], robots: RobotInputs[Array], candidates: CandidateInputs[Array]
) -> F64:
    """Estimated rho (N,) in [0, 1] of every candidate, from the points of its robot's cloud alone.

    0 where no point of the target was observed, and where the camera is inside the target's sphere.
    """
    valid = np.arange(clouds.points_m.shape[1]) < clouds.n_points[:, None]
    cloud_row, eyes_m = robots.cloud_row[candidates.robot_row], eyes(clouds, robots, candidates)
    return visible_shares(
        clouds.points_m, clouds.target_mask, valid, clouds.target_radius_m, cloud_row, eyes_m
    )


def visible_shares(
    points_m: F32, target_mask: Bools, valid: Bools, radius_m: F32, cloud_row: Ints, eyes_m: F32
) -> F64:
    """`visible_share` (N,) from eyes (N, 3) on the clouds (S, P, 3) that `cloud_row` (N,) names."""
    rho = np.zeros(len(eyes_m))
    for row in np.unique(cloud_row):
        rows = np.flatnonzero(cloud_row == row)
        cloud_m, mask = points_m[row][valid[row]], target_mask[row][valid[row]]
        rho[rows] = visible_share(cloud_m[~mask], cloud_m[mask], float(radius_m[row]), eyes_m[rows])
    return rho


def eyes(clouds: Clouds[Array], robots: RobotInputs[Array], candidates: CandidateInputs[Array]) -> F32:
    """The cameras (N, 3) of the candidates, in their target's frame."""
    robot = candidates.robot_row
    height_m = robots.camera_height_m[robot] - clouds.target_height_m[robots.cloud_row[robot]]
    return np.column_stack([candidates.base_xy_m, height_m]).astype(np.float32)


def visible_share(others_m: F32, target_m: F32, radius_m: float, eyes_m: F32) -> F64:
    """Share (N,) of the target's cells that nothing hides, seen from each eye (N, 3).

    Points of other objects (M, 3) and of the target (T, 3), the latter in farthest-point order, and eyes are
    in the target's frame. `radius_m` is the radius of the target's bounding sphere.
    """
    share = np.zeros(len(eyes_m))
    finite = np.isfinite(target_m).all(1)
    side_m = target_m[finite][:_TARGET_POINTS].astype(np.float32)
    usable = np.flatnonzero(np.linalg.norm(eyes_m, axis=1) > max(1.05 * radius_m, 1e-3))
    if not len(side_m) or not len(usable) or not radius_m > 0:
        return share
    whole_m = np.concatenate([side_m, side_m * np.array([-1, -1, 1], np.float32)])
    others_m = others_m[np.isfinite(others_m).all(1)].astype(np.float32)
    views = Views(eyes_m[usable].astype(np.float32), radius_m)
    front_m = closed(views.nearest_m(whole_m))
    on_target = front_m > -np.inf
    hidden = _hidden(views, others_m, front_m)
    seen = on_target & ~majority(hidden, on_target)
    share[usable] = seen.sum((1, 2)) / np.maximum(on_target.sum((1, 2)), 1)
    return share


def _hidden(views: Views, others_m: F32, front_m: F32) -> Bools:
    """Cells (N, cells, cells) in which something is clearly nearer to the eye than `front_m`."""
    hidden, limits = np.zeros(front_m.size, np.bool_), Limits.of(front_m)
    sectors = [views.before(others_m, rows, limits) for rows in views.sectors()]
    chosen = np.zeros(len(others_m), np.bool_)  # points whose disc may hide a target
    for pairs in sectors:
        chosen[pairs.point] = True
    discs, disc_of = fit_discs(others_m, chosen), np.cumsum(chosen) - 1
    if len(discs):
        for pairs in sectors:
            disc = disc_of[pairs.point]
            kept = views.reach(pairs, discs.radius_m[disc], limits)
            views.hide(discs, pairs.eye[kept], disc[kept], limits, hidden)
    return hidden.reshape(front_m.shape)


@dataclass(frozen=True, eq=False)
class Limits:
    """How near to each eye a disc must be to hide a cell of its window."""

    depth_m: F32  # (N * cells * cells,); inf where no target is seen
    nearest_m: F32  # (N,), the least of them
    farthest: F32  # (N,), in cells, from the window's middle to a corner of a cell with the target
    rows: tuple[F32, F32]  # (N,) each, the first and the last with a cell of the target
    columns: tuple[F32, F32]

    @classmethod
    def of(cls, front_m: F32) -> Limits:
        """Limits in front of the target's depths `front_m` (N, cells, cells), by the margin."""
        on_target = front_m > -np.inf
        depth_m = np.where(on_target, front_m, np.inf).astype(np.float32) + np.float32(_MARGIN_M)
        rows, columns = (_bounds(np.logical_or.reduce(on_target, axis)) for axis in (2, 1))
        corner = np.abs(np.arange(_CELLS) + 0.5 - _CELLS / 2) + 0.5
        farthest = (on_target * np.hypot(corner, corner[:, None])).max((1, 2)).astype(np.float32)
        return cls(depth_m.reshape(-1), depth_m.min((1, 2)), farthest, rows, columns)


def _bounds(cells: Bools) -> tuple[F32, F32]:
    """The first and the last true cell of each row (N, cells); without one the last is before the first."""
    first = np.where(cells.any(1), cells.argmax(1), _CELLS).astype(np.float32)
    last = np.where(cells.any(1), _CELLS - 1 - cells[:, ::-1].argmax(1), -1).astype(np.float32)
    return first, last


@dataclass(frozen=True, eq=False)
class Discs:
    """Small pieces of surface around points."""

    centre_m: F32  # (M, 3)
    normal: F32  # (M, 3)
    radius_m: F32  # (M,)

    def __len__(self) -> int:
        return len(self.radius_m)


def fit_discs(points_m: F32, chosen: Bools) -> Discs:
    """A disc for each chosen point (M,), in the plane of its neighbours and sized by their distance."""
    if len(points_m) <= _NEIGHBOURS or not chosen.any():  # too few for a surface
        return Discs(points_m[:0], points_m[:0], np.zeros(0, np.float32))
    centre_m = points_m[chosen]
    distance_m, row = KDTree(points_m).query(centre_m, _NEIGHBOURS + 1)
    around_m = points_m[row]
    around_m = around_m - around_m.mean(1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around_m, around_m))
    radius_m = np.minimum(_DISC_SHARE * distance_m[:, -1], _LARGEST_DISC_M)
    return Discs(centre_m, axes[:, :, 0].astype(np.float32), radius_m.astype(np.float32))


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of an eye and a point, by their rows."""

    eye: Ints  # (K,)
    point: Ints  # (K,)
    along_m: F32  # (K,), of the point, from the target's centre towards the eye
    beside_m2: F32  # (K,), its squared distance from the line between them


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
        self.half_m = radius_m / np.sqrt(1 - sine**2)  # (N,), half the window's side at the target's centre
        self.per_depth = 2 / _CELLS * self.half_m / self.distance_m  # (N,), a cell's width per metre of depth

    def sectors(self) -> list[Ints]:
        """Rows of eyes, divided by their direction from the target."""
        turned = np.argsort(np.arctan2(self.towards[:, 1], self.towards[:, 0]), kind="stable")
        return np.array_split(turned, -(-len(turned) // _EYES_AT_ONCE))

    def before(self, points_m: F32, rows: Ints, limits: Limits) -> Pairs:
        """Pairs where the largest disc around the point may be nearer to the eye than the limits."""
        some = self._beside(points_m, rows, limits)
        points_m = points_m[some]
        along_m = self.towards[rows] @ points_m.T
        ahead_m = self.distance_m[rows, None] - along_m
        beside_m2 = np.einsum("ij,ij->i", points_m, points_m) - along_m**2
        limit_m = self._slope(rows, limits)[:, None] * ahead_m + _LARGEST_DISC_M
        inside = (beside_m2 <= limit_m**2) & (along_m + _LARGEST_DISC_M > limits.nearest_m[rows, None])
        eye, point = np.nonzero(inside & (ahead_m > _NEAREST_M))
        return Pairs(rows[eye], some[point], along_m[eye, point], beside_m2[eye, point])

    def reach(self, pairs: Pairs, radius_m: F32, limits: Limits) -> Bools:
        """Mask (K,) of pairs from `before` that may hide a cell with discs of these radii (K,)."""
        eye = pairs.eye
        limit_m = self._slope(eye, limits) * (self.distance_m[eye] - pairs.along_m) + radius_m
        return (pairs.beside_m2 <= limit_m**2) & (pairs.along_m + radius_m > limits.nearest_m[eye])

    def _slope(self, rows: Ints, limits: Limits) -> F32:
        """Radius per depth of the cone around the target's cells, plus a hundredth of a cell for rounding."""
        return self.per_depth[rows] * (limits.farthest[rows] + np.float32(0.01))

    def _beside(self, points_m: F32, rows: Ints, limits: Limits) -> Ints:
        """Rows of points that, seen from above, may hide the target from one of these eyes: a superset."""
        towards = self.towards[rows, :2]
        angle = np.arctan2(towards[:, 1], towards[:, 0])
        middle, half = (angle[-1] + angle[0]) / 2, (angle[-1] - angle[0]) / 2
        behind_m = max(0.0, -float(limits.nearest_m[rows].min())) + _LARGEST_DISC_M
        widest_m = float((self._slope(rows, limits) * (self.distance_m[rows] + behind_m)).max())
        widest_m += 2 * _LARGEST_DISC_M
        flat_m = np.hypot(points_m[:, 0], points_m[:, 1])
        off = np.abs(np.arctan2(points_m[:, 1], points_m[:, 0]) - middle)
        off = np.minimum(off, 2 * np.pi - off)
        ahead = off <= half + np.arcsin(np.minimum(widest_m / np.maximum(flat_m, 1e-6), 1))
        return np.flatnonzero(ahead | (flat_m <= widest_m + behind_m))

    def nearest_m(self, points_m: F32) -> F32:
        """Depth towards the eye of the nearest point of each cell (N, cells, cells), or -inf."""
        depths = np.full((len(self.distance_m), _CELLS, _CELLS), -np.inf, np.float32)
        step = max(1, _AT_ONCE // max(len(points_m), 1))
        for start in range(0, len(depths), step):
            rows = slice(start, start + step)
            along_m = self.towards[rows] @ points_m.T
            ahead_m = self.distance_m[rows, None] - along_m
            per_cell_m = self.per_depth[rows, None] * np.maximum(ahead_m, _NEAREST_M)
            x = (self.right[rows] @ points_m.T) / per_cell_m + _CELLS / 2
            y = (self.up[rows] @ points_m.T) / per_cell_m + _CELLS / 2
            inside = (ahead_m > _NEAREST_M) & (x >= 0) & (x < _CELLS) & (y >= 0) & (y < _CELLS)
            eye, point = np.nonzero(inside)
            cell = (eye * _CELLS + y[eye, point].astype(np.int64)) * _CELLS + x[eye, point].astype(np.int64)
            np.maximum.at(depths[rows].reshape(-1), cell, along_m[eye, point])
        return depths

    def hide(self, discs: Discs, eye: Ints, disc: Ints, limits: Limits, hidden: Bools) -> None:
        """Set the cells of `hidden` (N * cells * cells,) in which a pair's disc is nearer than the limits.

        A disc projects to an ellipse: in each row of cells it covers those between the roots of a quadratic
        equation. Edge-on it is one cell thick.
        """
        centre_m, towards = discs.centre_m[disc], self.towards[eye]
        along_m = np.einsum("ij,ij->i", centre_m, towards)
        cell_m = self.per_depth[eye] * (self.distance_m[eye] - along_m)
        x = np.einsum("ij,ij->i", centre_m, self.right[eye]) / cell_m + np.float32(_CELLS / 2)
        y = np.einsum("ij,ij->i", centre_m, self.up[eye]) / cell_m + np.float32(_CELLS / 2)
        own_x, own_y = np.floor(x), np.floor(y)
        inside = (own_x >= 0) & (own_x < _CELLS) & (own_y >= 0) & (own_y < _CELLS)
        own = np.where(inside, (eye * _CELLS + own_y.astype(np.int64)) * _CELLS + own_x.astype(np.int64), -1)
        hidden[own[inside & (along_m > limits.depth_m[own])]] = True
        # The plane's rise towards the eye, by cell.
        normal = discs.normal[disc]
        facing = np.einsum("ij,ij->i", normal, towards)
        facing = np.where(np.abs(facing) < 1e-3, np.float32(1e-3), facing)
        rise_x = -np.einsum("ij,ij->i", normal, self.right[eye]) / facing * cell_m
        rise_y = -np.einsum("ij,ij->i", normal, self.up[eye]) / facing * cell_m
        # (dx^2 + dy^2) cell_m^2 + (rise_x dx + rise_y dy)^2 <= radius_m^2, solved for dx.
        cell2, radius_m = cell_m * cell_m, discs.radius_m[disc]
        a, whole = cell2 + rise_x * rise_x, cell2 + rise_x * rise_x + rise_y * rise_y
        reach = radius_m / cell_m * np.sqrt(a / whole)
        pair, row = _spread(*_within(y, reach, limits.rows, eye))
        dy = row + np.float32(0.5) - y[pair]
        root = (a * radius_m * radius_m)[pair] - (cell2 * whole)[pair] * dy * dy
        half = np.sqrt(np.maximum(root, 0)) / a[pair]
        middle = x[pair] - (rise_x * rise_y / a)[pair] * dy
        span, column = _spread(*_within(middle, half, limits.columns, eye[pair]))
        rows = pair[span]
        cell = ((eye * _CELLS)[pair] + row)[span] * _CELLS + column
        at_m = (along_m[pair] + rise_y[pair] * dy - (rise_x * x)[pair])[span]
        at_m += rise_x[rows] * (column + np.float32(0.5))
        hidden[cell[(at_m > limits.depth_m[cell]) & (cell != own[rows])]] = True


def _within(middle: F32, half: F32, bounds: tuple[F32, F32], eye: Ints) -> tuple[Ints, Ints]:
    """First and last cell (K,) with its centre within `half` cells of `middle`, in the eyes' bounds."""
    low = np.clip(np.ceil(middle - half - np.float32(0.5)), bounds[0][eye], np.float32(_CELLS))
    high = np.clip(np.floor(middle + half - np.float32(0.5)), np.float32(-1), bounds[1][eye])
    return low.astype(np.int32), high.astype(np.int32)


def _spread(low: Ints, high: Ints) -> tuple[Ints, Ints]:
    """The row and the value of each whole number from low (K,) to high (K,), both included."""
    count = np.maximum(high - low + 1, 0)
    row = np.repeat(np.arange(len(low), dtype=np.int32), count)
    begin = np.cumsum(count, dtype=np.int32) - count
    return row, np.arange(len(row), dtype=np.int32) - (begin - low)[row]


def closed(depths_m: F32) -> F32:
    """Depths with the gaps between points filled from adjacent cells; the outline does not grow."""
    padded = np.pad(depths_m, ((0, 0), (1, 1), (1, 1)), constant_values=-np.inf)
    grown = np.maximum.reduce([padded[:, 1:-1, 1:-1], *_beside(padded)])
    # Cells outside the window count as full: the target may touch its border.
    full = np.pad(grown > -np.inf, ((0, 0), (1, 1), (1, 1)), constant_values=True)
    inside = np.logical_and.reduce([full[:, 1:-1, 1:-1], *_beside(full)])
    return np.where((depths_m > -np.inf) | inside, grown, -np.inf).astype(np.float32)


def majority(hidden: Bools, on_target: Bools) -> Bools:
    """Majority filter over the target's cells (3 x 3): closes holes between points, removes specks."""
    counts: list[Array] = []
    for cells in (hidden, on_target):
        padded = np.pad(cells.astype(np.int8), ((0, 0), (1, 1), (1, 1)))
        rows = padded[:, 2:] + padded[:, 1:-1] + padded[:, :-2]
        counts.append(rows[:, :, 2:] + rows[:, :, 1:-1] + rows[:, :, :-2])
    return 2 * counts[0] > counts[1]


def _beside(padded: Array) -> list[Array]:
    return [padded[:, 2:, 1:-1], padded[:, :-2, 1:-1], padded[:, 1:-1, 2:], padded[:, 1:-1, :-2]]

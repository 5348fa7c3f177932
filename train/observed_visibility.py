"""Estimate rho from the observed cloud: a small z-buffer from each candidate's camera.

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

import numpy as np
from scipy.spatial import KDTree

from datagen.train.inputs import F32, F64, Array, Bools, CandidateInputs, Clouds, Ints, RobotInputs

_CELLS = 16  # of a window, each way
_TARGET_POINTS = 128  # that stand for the target's observed side
# A disc reaches about half as far as the eighth neighbour, so that discs just close a surface.
_NEIGHBOURS = 8
_DISC_SHARE = 0.55
_LARGEST_DISC_M = 0.06
_MARGIN_M = 0.02  # a disc hides what lies farther behind it than this
_NEAREST_M = 0.02  # to an eye; points before it are the robot's own
_PARTY = 32  # eyes that look at the target from about one side are dealt with together
_AT_ONCE = 1 << 13  # pairs of eye and point: bounds memory, and stays in the cache


def observed_visibility(
    clouds: Clouds[Array], robots: RobotInputs[Array], candidates: CandidateInputs[Array]
) -> F64:
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


def eyes(clouds: Clouds[Array], robots: RobotInputs[Array], candidates: CandidateInputs[Array]) -> F32:
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
    views = Views(eyes_m[usable].astype(np.float32), radius_m)
    front_m = closed(views.nearest_m(whole_m))
    on_target = front_m > -np.inf
    hidden = _hidden(views, others_m, front_m)
    seen = on_target & ~majority(hidden, on_target)
    share[usable] = seen.sum((1, 2)) / np.maximum(on_target.sum((1, 2)), 1)
    return share


def _hidden(views: Views, others_m: F32, front_m: F32) -> Bools:
    """In which cells (N, cells, cells) something lies clearly before what is there at `front_m`."""
    hidden = np.zeros(front_m.size, np.bool_)
    limit_m = np.where(front_m > -np.inf, front_m, np.inf).astype(np.float32) + np.float32(_MARGIN_M)
    nearest_m = limit_m.min((1, 2))
    parties = [rows for rows in _parties(views.towards) if np.isfinite(nearest_m[rows]).any()]
    beside = [views.beside(others_m, rows, _LARGEST_DISC_M) for rows in parties]
    asked = np.zeros(len(others_m), np.bool_)
    for rows, points in zip(parties, beside, strict=True):
        _, point = views.before(others_m[points], _LARGEST_DISC_M, rows, nearest_m[rows])
        asked[points[point]] = True
    discs, disc_of = fit_discs(others_m, asked), np.cumsum(asked) - 1
    pairs, n_pairs = list[tuple[Ints, Ints]](), 0
    for rows, points in zip(parties, beside, strict=True):
        near = disc_of[points[asked[points]]] if len(discs) else np.zeros(0, np.int64)
        eye, disc = views.before(discs.centre_m[near], discs.radius_m[near], rows, nearest_m[rows])
        pairs.append((rows[eye], near[disc]))
        n_pairs += len(eye)
        if n_pairs >= _AT_ONCE or rows is parties[-1]:
            eye, disc = (np.concatenate(part) for part in zip(*pairs, strict=True))
            for k in range(0, n_pairs, _AT_ONCE):
                views.hide(discs, eye[k : k + _AT_ONCE], disc[k : k + _AT_ONCE], limit_m.reshape(-1), hidden)
            pairs, n_pairs = [], 0
    return hidden.reshape(front_m.shape)


def _parties(towards: F32) -> list[Ints]:
    """Rows of directions (N, 3), split at the middle of their widest axis until each party is small."""
    parties, open_ = list[Ints](), [np.arange(len(towards))]
    while open_:
        rows = open_.pop()
        if len(rows) <= _PARTY:
            parties.append(rows)
            continue
        some = towards[rows]
        order = rows[np.argsort(some[:, int(np.ptp(some, axis=0).argmax())], kind="stable")]
        open_ += [order[: len(order) // 2], order[len(order) // 2 :]]
    return parties


@dataclass(frozen=True, eq=False)
class Discs:
    """Small pieces of surface around points: where, which way, how large."""

    centre_m: F32  # (M, 3)
    normal: F32  # (M, 3)
    radius_m: F32  # (M,)

    def __len__(self) -> int:
        return len(self.radius_m)


def fit_discs(points_m: F32, asked: Bools) -> Discs:
    """A disc for each asked point (M,), in the plane of its neighbours and as large as they are far."""
    if len(points_m) <= _NEIGHBOURS or not asked.any():  # too few to tell a surface
        return Discs(points_m[:0], points_m[:0], np.zeros(0, np.float32))
    centre_m = points_m[asked]
    distance_m, row = KDTree(points_m).query(centre_m, _NEIGHBOURS + 1)
    around_m = points_m[row]
    around_m = around_m - around_m.mean(1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around_m, around_m))
    radius_m = np.minimum(_DISC_SHARE * distance_m[:, -1], _LARGEST_DISC_M)
    return Discs(centre_m, axes[:, :, 0].astype(np.float32), radius_m.astype(np.float32))


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
        self.per_depth = 2 / _CELLS * self.half_m / self.distance_m  # (N,), of a cell's width, by depth

    def beside(self, points_m: F32, rows: Ints, slack_m: float) -> Ints:
        """Points that may lie between the target and any of some eyes, or within slack_m of that; or more.

        All lie in a cone around the eyes' common direction, widened by how wide a window's pyramid gets.
        """
        middle = self.towards[rows].mean(0)
        middle /= max(float(np.linalg.norm(middle)), 1e-6)
        spread = float(np.arccos(np.clip(self.towards[rows] @ middle, -1, 1).min()))
        behind_m = float(self.half_m[rows].max()) + _MARGIN_M + slack_m
        slope = np.sqrt(2) * self.half_m[rows] / self.distance_m[rows]
        wide_m = float((slope * (self.distance_m[rows] + behind_m)).max()) + slack_m
        far_m = np.sqrt(np.einsum("ij,ij->i", points_m, points_m))
        close = far_m <= np.hypot(wide_m, behind_m)
        angle = spread + np.arcsin(np.minimum(wide_m / np.maximum(far_m, 1e-6), 1)) + 1e-3
        return np.flatnonzero(close | (points_m @ middle >= far_m * np.cos(np.minimum(angle, np.pi))))

    def before(self, points_m: F32, slack_m: F32 | float, rows: Ints, nearest_m: F32) -> tuple[Ints, Ints]:
        """Pairs of eye (an index into `rows`) and point that lies in the cone around the eye's window, or
        within its slack_m (M,) of it, nearer to the eye than nearest_m (len(rows),).
        """
        along_m = self.towards[rows] @ points_m.T
        ahead_m = self.distance_m[rows, None] - along_m
        slope = np.sqrt(2.0, dtype=np.float32) * self.half_m[rows] / self.distance_m[rows]
        limit_m = slope[:, None] * ahead_m + slack_m
        inside = np.einsum("ij,ij->i", points_m, points_m) - along_m * along_m <= limit_m * limit_m
        inside &= ahead_m > _NEAREST_M
        inside &= along_m + slack_m > nearest_m[:, None]
        eye, point = np.nonzero(inside)
        return eye, point

    def nearest_m(self, points_m: F32) -> F32:
        """How far towards the eye the nearest point of each cell (N, cells, cells) is, or -inf."""
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

    def hide(self, discs: Discs, eye: Ints, disc: Ints, limit_m: F32, hidden: Bools) -> None:
        """Set the cells of `hidden` (N * cells * cells,) in which a pair's disc is nearer than limit_m.

        A disc is seen as an ellipse: in each row of cells it covers those from one root of a quadratic
        equation to the other. One seen from its edge is one cell thick.
        """
        centre_m, towards = discs.centre_m[disc], self.towards[eye]
        along_m = np.einsum("ij,ij->i", centre_m, towards)
        cell_m = self.per_depth[eye] * (self.distance_m[eye] - along_m)
        x = np.einsum("ij,ij->i", centre_m, self.right[eye]) / cell_m + np.float32(_CELLS / 2)
        y = np.einsum("ij,ij->i", centre_m, self.up[eye]) / cell_m + np.float32(_CELLS / 2)
        own_x, own_y = np.floor(x), np.floor(y)
        inside = (own_x >= 0) & (own_x < _CELLS) & (own_y >= 0) & (own_y < _CELLS)
        own = np.where(inside, (eye * _CELLS + own_y.astype(np.int64)) * _CELLS + own_x.astype(np.int64), -1)
        hidden[own[inside & (along_m > limit_m[own])]] = True
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
        pair, row = _spread(*_within(y, reach))
        dy = row + np.float32(0.5) - y[pair]
        root = (a * radius_m * radius_m)[pair] - (cell2 * whole)[pair] * dy * dy
        half = np.sqrt(np.maximum(root, 0)) / a[pair]
        middle = x[pair] - (rise_x * rise_y / a)[pair] * dy
        span, column = _spread(*_within(middle, half))
        rows = pair[span]
        cell = ((eye * _CELLS)[pair] + row)[span] * _CELLS + column
        at_m = (along_m[pair] + rise_y[pair] * dy - (rise_x * x)[pair])[span]
        at_m += rise_x[rows] * (column + np.float32(0.5))
        hidden[cell[(at_m > limit_m[cell]) & (cell != own[rows])]] = True


def _within(middle: F32, half: F32) -> tuple[Ints, Ints]:
    """First and last of the cells whose centres lie within `half` of `middle` (K,), in cells."""
    low = np.clip(np.ceil(middle - half - np.float32(0.5)), 0, _CELLS).astype(np.int32)
    high = np.clip(np.floor(middle + half - np.float32(0.5)), -1, _CELLS - 1).astype(np.int32)
    return low, high


def _spread(low: Ints, high: Ints) -> tuple[Ints, Ints]:
    """The row and the value of each whole number from low (K,) to high (K,), both included."""
    count = np.maximum(high - low + 1, 0)
    row = np.repeat(np.arange(len(low), dtype=np.int32), count)
    begin = np.cumsum(count, dtype=np.int32) - count
    return row, np.arange(len(row), dtype=np.int32) - (begin - low)[row]


def closed(depths_m: F32) -> F32:
    """Gaps between points filled from the cells beside them; the outline does not grow."""
    padded = np.pad(depths_m, ((0, 0), (1, 1), (1, 1)), constant_values=-np.inf)
    grown = np.maximum.reduce([padded[:, 1:-1, 1:-1], *_beside(padded)])
    # Cells outside the window hold back nothing: the target may touch its border.
    full = np.pad(grown > -np.inf, ((0, 0), (1, 1), (1, 1)), constant_values=True)
    inside = np.logical_and.reduce([full[:, 1:-1, 1:-1], *_beside(full)])
    return np.where((depths_m > -np.inf) | inside, grown, -np.inf).astype(np.float32)


def majority(hidden: Bools, on_target: Bools) -> Bools:
    """Hidden where most of the target's cells around a cell are: holes between points close, specks go."""
    counts: list[Array] = []
    for cells in (hidden, on_target):
        padded = np.pad(cells.astype(np.int8), ((0, 0), (1, 1), (1, 1)))
        rows = padded[:, 2:] + padded[:, 1:-1] + padded[:, :-2]
        counts.append(rows[:, :, 2:] + rows[:, :, 1:-1] + rows[:, :, :-2])
    return 2 * counts[0] > counts[1]


def _beside(padded: Array) -> list[Array]:
    return [padded[:, 2:, 1:-1], padded[:, :-2, 1:-1], padded[:, 1:-1, 2:], padded[:, 1:-1, :-2]]

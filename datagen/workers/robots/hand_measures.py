"""Measure a hand as it closes: its TCP, where its pads are, and how far apart they stand."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import ConvexHull

from datagen.schemas.identity import digest_of
from datagen.workers.geometry.mesh import F64, transformed, transformed_parts
from datagen.workers.geometry.transforms import inverse
from datagen.workers.kinematics.tree import Ints, KinematicTree, frame_poses
from datagen.workers.robots.gripper import Gripper, Linkage, Parts
from datagen.workers.robots.robot_file import RobotSource

_SNAP = np.cos(np.radians(15))  # directions nearer than this to an axis of the palm are that axis
_KNOTS = 33  # openings that are measured
_CELLS = 40  # of the grid over the fingers, each way
_PAD_M = 0.0015  # how far from the first contact the surface of a pad may lie
_PARALLEL = 2 * np.tan(np.radians(5))  # faces that touch with a smaller slope between them are parallel
_NEXT_M = 1e-6  # between lines on one face
_MOVES = 0.5  # pads are where the fingers move apart by at least this share of the most
_LEAST_OPENING_M, _CENTRED_M, _APART_M = 0.005, 0.004, 0.002
_HALVINGS = 14
_OVERLAP = (
    "its fingers overlap even when they are open",
    "Leave out links with arm.ignore, give curved ones convex <collision> parts, or correct [hand.range]",
)


@dataclass(frozen=True, eq=False)
class Fingers:
    """B bodies of a hand, the palm first, in its frame; one coordinate moves them, 0 closed and 1 open."""

    tree: KinematicTree  # frames: the bodies
    parts_m: tuple[Parts, ...]  # (B,) body frames
    parents: tuple[int, ...]  # (B - 1,) the body that carries each body after the palm

    def poses(self, q: float) -> F64:
        """Poses (B, 4, 4) of the bodies."""
        return frame_poses(self.tree, np.array([[q]]))[0]

    @property
    def root(self) -> Ints:
        """(B,) the body next to the palm that carries each body; 0 for the palm."""
        root = [0]
        for k, parent in enumerate(self.parents):
            root.append(root[parent] if parent else k + 1)
        return np.array(root)

    def means(self, q: float) -> F64:
        """Middles (R, 3) of what each body next to the palm carries, of those with shapes."""
        T, root = self.poses(q), self.root
        found = {r: list[F64]() for r in root.tolist() if r}
        for k, parts in enumerate(self.parts_m):
            if parts and root[k]:
                found[int(root[k])].append(T[k, :3, :3] @ np.concatenate(parts).mean(axis=0) + T[k, :3, 3])
        return np.array([np.mean(rows, axis=0) for rows in found.values() if rows]).reshape(-1, 3)

    def closing(self) -> F64:
        """The direction (3,) in which the fingers lie apart, half open."""
        means = self.means(0.5)
        return _snapped(np.linalg.svd(means - means.mean(axis=0))[2][0]) if len(means) > 1 else np.eye(3)[1]


def _snapped(direction: F64) -> F64:
    unit = direction / np.linalg.norm(direction)
    axis = int(np.abs(unit).argmax())
    return np.eye(3)[axis] * np.sign(unit[axis]) if abs(unit[axis]) > _SNAP else unit


class HandMeasures:
    """What a hand measures; `T_palm_tcp` is the given TCP, or lies between the pads of the closed hand."""

    def __init__(self, source: RobotSource, fingers: Fingers, T_palm_tcp: F64 | None) -> None:
        self._wrong, self._fingers, self._tree = source.wrong, fingers, fingers.tree
        self._is_given = T_palm_tcp is not None
        half = fingers.means(0.5)
        if T_palm_tcp is None:
            y = fingers.closing()
            ahead = half.mean(axis=0) if len(half) else np.eye(3)[2]
            z = _snapped(ahead - (ahead @ y) * y)
            T_palm_tcp = np.eye(4)
            T_palm_tcp[:3, :3] = np.column_stack([np.cross(y, z), y, z])
        self.T_palm_tcp: F64 = T_palm_tcp
        along = (half - T_palm_tcp[:3, 3]) @ T_palm_tcp[:3, 1]
        if len(along) and not self._is_given:
            along = along - (along.max() + along.min()) / 2
        roots = [r for r in dict.fromkeys(fingers.root.tolist()) if r and self._has_shapes(r)]
        side = dict(zip(roots, np.sign(along).astype(int).tolist(), strict=True))
        self.side: Ints = np.array([side.get(r, 0) for r in fingers.root.tolist()])
        if set(self.side[1:].tolist()) - {0} != {1, -1}:
            fix = "Use a hand of two fingers that both move, or name their joints"
            problem = (
                "only one finger moves" if len(roots) == 1 else "no fingers lie on both sides of the hand"
            )
            raise self._wrong("hand.fingers", problem, fix)
        self._hulls = [[ConvexHull(part) for part in parts] for parts in fingers.parts_m]

    def _has_shapes(self, root: int) -> bool:
        return any(p for p, r in zip(self._fingers.parts_m, self._fingers.root, strict=True) if r == root)

    def gripper(self, name: str, pad_size_m: tuple[float, float] | None) -> Gripper:
        """The gripper. InputError where the hand cannot close on anything."""
        slides = self._slides()
        if not (slides and self._is_given and pad_size_m and self._meets(pad_size_m)):
            q_closed, pads = self._pads()
            if pad_size_m is None:
                x, z = (np.ptp(pads[0][:, k]) + cell for k, cell in zip((0, 2), self._cell_m, strict=True))
                pad_size_m = (float(x), float(z))
            if not self._is_given:
                middle = np.concatenate(pads)[:, :3].mean(axis=0)
                middle[1] = (pads[0][:, 1].mean() + pads[1][:, 1].mean()) / 2
                self.T_palm_tcp = self.T_palm_tcp.copy()
                self.T_palm_tcp[:3, 3] += self.T_palm_tcp[:3, :3] @ middle
                pads = [np.column_stack([rows[:, :3] - middle, rows[:, 3:]]) for rows in pads]
            if not (slides and self._meets(pad_size_m)):
                return self._linkage(name, pad_size_m, q_closed, pads)
        from_palm, parts_m = inverse(self.T_palm_tcp), self._fingers.parts_m
        palm = transformed_parts(parts_m[0], from_palm)
        first = 1 if self.side[1] > 0 else 2
        left, right = (
            transformed_parts(parts_m[k], from_palm @ self._tree.T_parent_joint[k - 1])
            for k in (first, 3 - first)
        )
        opening, depth = float(2 * self._tree.ratio[0]), -max(float(part[:, 2].max()) for part in palm)
        parts = [part.tolist() for part in (*palm, *left, *right)]
        digest = digest_of([name, opening, list(pad_size_m), depth, parts])
        return Gripper(name, digest, opening, pad_size_m, depth, palm, (left, right))

    def _slides(self) -> bool:
        """Whether the hand is two fingers that slide from position 0 along y, one as far as the other."""
        tree = self._tree
        if len(tree.parent) != 2 or not tree.slides.all() or (tree.parent >= 0).any() or tree.offset.any():
            return False
        travel = np.einsum("jab,jb->ja", tree.T_parent_joint[:, :3, :3], tree.axis) * tree.ratio[:, None]
        even = tree.ratio[0] == tree.ratio[1] > _LEAST_OPENING_M / 2
        outwards = self.T_palm_tcp[:3, 1] * tree.ratio[0]
        return bool(even and np.allclose(travel * self.side[1:, None], outwards, atol=1e-6))

    def _meets(self, pad_size_m: tuple[float, float]) -> bool:
        """Whether the pads touch at the TCP while the joints are closed."""
        half = np.array([pad_size_m[0], np.inf, pad_size_m[1]]) / 2
        left, right = (self._nearest(0.0, side, -half, half) for side in (1, -1))
        return not _APART_M < left - right < np.inf

    def _poses(self, q: float) -> F64:
        return inverse(self.T_palm_tcp) @ self._fingers.poses(q)

    def _surface(self, q: float, side: int, x: F64, z: F64) -> F64:
        """The inner surface of one side along lines through (x, z): rows (G, 4) of x, y, z and body.

        y is infinite beside the fingers.
        """
        T = self._poses(q)
        best, body = np.full(len(x), side * np.inf), np.zeros(len(x))
        for b in np.flatnonzero(self.side == side).tolist():
            for hull in self._hulls[b]:
                n = hull.equations[:, :3] @ T[b, :3, :3].T
                rest = np.outer(x, n[:, 0]) + np.outer(z, n[:, 2]) + (hull.equations[:, 3] - n @ T[b, :3, 3])
                is_flat = np.abs(n[:, 1]) < 1e-9
                y = -rest / np.where(is_flat, 1.0, n[:, 1])
                low = np.where((n[:, 1] < 0) & ~is_flat, y, -np.inf).max(axis=1)
                high = np.where((n[:, 1] > 0) & ~is_flat, y, np.inf).min(axis=1)
                is_inside = (low <= high) & ~(is_flat & (rest > 0)).any(axis=1)
                near = np.where(is_inside, low if side > 0 else high, side * np.inf)
                is_closer = near * side < best * side
                best[is_closer], body[is_closer] = near[is_closer], b
        return np.column_stack([x, best, z, body])

    def _nearest(self, q: float, side: int, low: F64, high: F64) -> float:
        """The y of one side where it comes nearest to the other between the corners (3,) of a column along y.

        Of a convex shape, that is on one of its edges, or where an edge of the column meets a face.
        """
        x, z = (grid.ravel() for grid in np.meshgrid(*zip(low[::2], high[::2], strict=True)))
        found = [self._surface(q, side, x, z)[:, 1]]
        T = self._poses(q)
        for b in np.flatnonzero(self.side == side).tolist():
            for hull in self._hulls[b]:
                corners = transformed(hull.points[hull.simplices], T[b])  # (F, 3, 3)
                start, along = corners, np.roll(corners, -1, axis=1) - corners
                with np.errstate(divide="ignore", invalid="ignore"):
                    ends = np.stack([low - start, high - start])[..., ::2] / along[..., ::2]
                # An edge in a side of the column is within it.
                ends = np.where(np.isnan(ends), np.array([-np.inf, np.inf])[:, None, None, None], ends)
                enter = np.maximum(np.min(ends, axis=0).max(axis=-1), 0.0)
                leave = np.minimum(np.max(ends, axis=0).min(axis=-1), 1.0)
                met = enter <= leave
                found.extend(start[met][:, 1] + share[met] * along[met][:, 1] for share in (enter, leave))
        return float(side * (side * np.concatenate(found)).min())

    def _pads(self) -> tuple[float, list[F64]]:
        """The coordinate at which the fingers meet, and points (P, 4) of both pads: x, y, z and body."""
        T = self._poses(0.0)
        corners = [
            transformed(part, T[b])
            for b in np.flatnonzero(self.side).tolist()
            for part in self._fingers.parts_m[b]
        ]
        points = np.concatenate(corners)
        ends = [(points[:, k].min(), points[:, k].max()) for k in (0, 2)]
        axes = [np.linspace(low, high, _CELLS + 2)[1:-1] for low, high in ends]
        self._cell_m = [float(axis[1] - axis[0]) for axis in axes]
        x, z = (grid.ravel() for grid in np.meshgrid(*axes, indexing="ij"))

        def surfaces(q: float) -> tuple[F64, list[F64]]:
            """Gaps (G,) along y, infinite where the fingers do not part, and both surfaces."""
            sides = [self._surface(q, side, x, z) for side in (1, -1)]
            gap = sides[0][:, 1] - sides[1][:, 1]
            met = np.isfinite(gap)
            gap[~met] = np.inf
            if met.any():
                here, wide = self._poses(q), self._poses(1.0)
                moved = [_carried(rows[met], here, wide)[:, 1] - rows[met, 1] for rows in sides]
                apart = moved[0] - moved[1]
                gap[np.flatnonzero(met)[apart < _MOVES * apart.max()]] = np.inf
            return gap, sides

        q, (gap, sides) = 0.0, surfaces(0.0)
        if gap.min() < 0:  # they meet on the way
            low, high = 0.0, 1.0
            for _ in range(_HALVINGS):
                q = (low + high) / 2
                low, high = (q, high) if surfaces(q)[0].min() < 0 else (low, q)
            q, (gap, sides) = high, surfaces(high)
            if gap.min() < 0:
                raise self._wrong("hand", *_OVERLAP)
        if not np.isfinite(gap).any():
            fix = "Correct hand.tcp, hand.fingers or hand.range"
            raise self._wrong("hand", "its fingers do not meet: the hand cannot close on anything", fix)
        is_pad = np.abs(gap - self._touching(q, gap, x, z)) < _PAD_M
        return q, [rows[is_pad] for rows in sides]

    def _touching(self, q: float, gap: F64, x: F64, z: F64) -> F64:
        """The gap (G,) between the planes of the faces that touch first; one number where these are parallel.

        Fingers that turn may touch with an edge of their pads, of which the rest is tilted.
        """
        first = int(gap.argmin())
        at_x, at_z = (
            x[first] + np.array([-1, 1, 0, 0]) * _NEXT_M,
            z[first] + np.array([0, 0, -1, 1]) * _NEXT_M,
        )
        left, right = (self._surface(q, side, at_x, at_z)[:, 1] for side in (1, -1))
        slope = np.diff((left - right).reshape(2, 2))[:, 0] / (2 * _NEXT_M)
        if not np.linalg.norm(slope) > _PARALLEL:
            return np.full_like(gap, gap.min())
        return gap.min() + slope[0] * (x - x[first]) + slope[1] * (z - z[first])

    def _linkage(self, name: str, pad_size_m: tuple[float, float], q: float, pads: list[F64]) -> Gripper:
        before, coordinate = self._poses(q), np.linspace(q, 1.0, _KNOTS)
        opening, depth = np.empty(_KNOTS), np.empty(_KNOTS)
        for k, at in enumerate(coordinate.tolist()):
            moved = np.concatenate([_carried(rows, before, self._poses(at)) for rows in pads])
            middle = (moved.min(axis=0) + moved.max(axis=0)) / 2
            depth[k] = middle[2]
            # As far apart as a box of the pads' size fits between them.
            half = np.array([pad_size_m[0], np.inf, pad_size_m[1]]) / 2
            inner = [self._nearest(at, side, middle - half, middle + half) for side in (1, -1)]
            if not np.isfinite(inner).all():
                fix = "Name the joints of two opposite fingers in hand.fingers, or a smaller [hand.range]"
                raise self._wrong("hand", "its fingers swing past one another before they are open", fix)
            opening[k] = max(inner[0] - inner[1], 0.0)
            if abs(sum(inner)) / 2 > _CENTRED_M:
                fix = "Correct hand.tcp, or name the joints of two opposite fingers in hand.fingers"
                raise self._wrong("hand", "its fingers do not close on the middle of its TCP", fix)
        if not opening.any():
            raise self._wrong("hand", *_OVERLAP)
        end = int(np.argmax(opening)) + 1
        falling = np.flatnonzero(np.diff(opening[:end]) <= 0)
        some = slice(int(falling[-1]) + 1 if len(falling) else 0, end)
        opening, depth, coordinate = opening[some], depth[some], coordinate[some]
        if len(opening) < 2 or opening[-1] < _LEAST_OPENING_M:
            problem = f"opens by {1000 * float(opening[-1]):.1f} mm: the hand cannot close on anything"
            if opening[-1] >= _LEAST_OPENING_M:
                problem = "its fingers do not part between the closed and the open position"
            raise self._wrong("hand", problem, "Give the closed and open positions in [hand.range]")
        closed, tree = self._poses(float(coordinate[0])), self._tree
        T_first = np.matmul(inverse(self.T_palm_tcp), tree.T_parent_joint)
        tree = tree._replace(
            T_parent_joint=np.where((tree.parent < 0)[:, None, None], T_first, tree.T_parent_joint),
            # A body's frame is that of the TCP while the hand is closed.
            frame_joint=np.append(tree.frame_joint, -1),
            T_joint_frame=np.stack([np.eye(4), *map(inverse, closed[1:]), np.eye(4)]),
        )
        bodies = zip(self._fingers.parts_m, closed, strict=True)
        parts = tuple(transformed_parts(body, T) for body, T in bodies)
        back = -max(float(part[:, 2].max()) for part in parts[0])
        measured = [opening.tolist(), coordinate.tolist(), depth.tolist()]
        shapes = [[part.tolist() for part in body] for body in parts]
        digest = digest_of(
            [name, pad_size_m, measured, shapes, [np.asarray(a, float).tolist() for a in tree]]
        )
        linkage = Linkage(tree, parts, self.side, opening, coordinate, depth)
        found = Gripper(name, digest, float(opening[-1]), pad_size_m, back, parts[0], ((), ()), linkage)
        return replace(found, finger_parts_m=found.fingers_in[0])


def _carried(points: F64, before: F64, after: F64) -> F64:
    """Where points (P, 4) of x, y, z and body are, (P, 3), after the bodies moved."""
    body = points[:, 3].astype(np.int64)
    T = after @ np.linalg.inv(before)
    return np.einsum("pij,pj->pi", T[body, :3, :3], points[:, :3]) + T[body, :3, 3]

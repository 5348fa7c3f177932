"""Contacts between many poses of moving convex parts and static ones.

Poses are handled together: bounding boxes of all of them are compared as arrays, and only pairs whose boxes
overlap are given to GJK. Parts are solid, so a part inside another one is a contact too.
"""

# coal defines its names at import time, which type checkers do not see.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import coal
import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.objects.model import ObjectModel
from datagen.workers.robots.hulls import polyhedron

Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]


class Shape:
    """A convex part as coal's polyhedron, built on first use: most parts are never used."""

    __slots__ = ("_built", "_corners_m")

    def __init__(self, corners_m: F32 | F64) -> None:
        self._corners_m, self._built = corners_m, None

    def __call__(self) -> Any:
        if self._built is None:
            self._built = polyhedron(self._corners_m)
        return self._built


@dataclass(frozen=True, eq=False)
class Hulls:
    """P convex parts that move with O owners; boxes are in the owners' frames."""

    shapes: tuple[Shape, ...]
    owner: Ints  # (P,)
    center_m: F64  # (P, 3), of the part's box
    half_m: F64  # (P, 3)

    def __len__(self) -> int:
        return len(self.shapes)

    def rows(self, chosen: Ints) -> Hulls:
        """Some of the parts, in the order given, with their owners' numbers as before."""
        shapes = tuple(self.shapes[k] for k in chosen.tolist())
        return Hulls(shapes, self.owner[chosen], self.center_m[chosen], self.half_m[chosen])


@dataclass(frozen=True, eq=False)
class Placed:
    """F static convex parts, with their boxes along the world's axes."""

    shapes: tuple[Shape, ...]
    poses: tuple[Any, ...]  # coal's transforms
    low_m: F64  # (F, 3)
    high_m: F64  # (F, 3)

    def __len__(self) -> int:
        return len(self.shapes)

    def rows(self, chosen: Ints) -> Placed:
        """Some of the parts, in the order given."""
        return Placed(
            tuple(self.shapes[k] for k in chosen.tolist()),
            tuple(self.poses[k] for k in chosen.tolist()),
            self.low_m[chosen],
            self.high_m[chosen],
        )

    def within(self, low_m: F64, high_m: F64) -> Ints:
        """Rows of the parts whose box meets the box from `low_m` to `high_m`, each (3,)."""
        return np.flatnonzero(((self.low_m <= high_m) & (self.high_m >= low_m)).all(axis=1))


def hulls_of(parts_by_owner: Sequence[Sequence[F32]]) -> Hulls:
    """Parts of owners 0, 1, ..., each (V, 3) in its owner's frame."""
    parts = [p for parts in parts_by_owner for p in parts]
    owner = [k for k, parts in enumerate(parts_by_owner) for _ in parts]
    low = np.array([p.min(axis=0) for p in parts], np.float64).reshape(-1, 3)
    high = np.array([p.max(axis=0) for p in parts], np.float64).reshape(-1, 3)
    shapes = tuple(map(Shape, parts))
    return Hulls(shapes, np.array(owner, np.int64), (low + high) / 2, (high - low) / 2)


def place(parts_m: Sequence[F32 | F64]) -> Placed:
    """Parts whose corners are given in the world frame."""
    low = np.array([p.min(axis=0) for p in parts_m], np.float64).reshape(-1, 3)
    high = np.array([p.max(axis=0) for p in parts_m], np.float64).reshape(-1, 3)
    here = coal.Transform3s(np.eye(3), np.zeros(3))
    return Placed(tuple(map(Shape, parts_m)), (here,) * len(parts_m), low, high)


_objects: WeakKeyDictionary[ObjectModel, Hulls] = WeakKeyDictionary()


def object_hulls(model: ObjectModel) -> Hulls:
    """An object's parts, owner 0; built once for as long as the model lives."""
    if model not in _objects:
        _objects[model] = hulls_of([model.convex_parts_m])
    return _objects[model]


def place_object(model: ObjectModel, T_world_object: F64) -> Placed:
    """An object's parts at its pose (4, 4)."""
    hulls = object_hulls(model)
    R, t = T_world_object[:3, :3], T_world_object[:3, 3]
    corners = [p.astype(np.float64) @ R.T + t for p in model.convex_parts_m]
    pose = coal.Transform3s(np.ascontiguousarray(R), t)
    low, high = ([f(c, axis=0) for c in corners] for f in (np.min, np.max))
    return Placed(hulls.shapes, (pose,) * len(corners), np.array(low), np.array(high))


def joined(groups: Sequence[Placed]) -> Placed:
    """All groups' parts, in order."""
    return Placed(
        tuple(s for g in groups for s in g.shapes),
        tuple(p for g in groups for p in g.poses),
        np.concatenate([g.low_m.reshape(-1, 3) for g in groups]),
        np.concatenate([g.high_m.reshape(-1, 3) for g in groups]),
    )


def hits(
    moving: Hulls,
    T_world_owner: F64,
    still: Placed,
    margin_m: float = 0.0,
    allowed: Bools | None = None,
    first_only: bool = False,
) -> Bools:
    """Whether each of M poses (M, O, 4, 4) of the owners comes nearer than `margin_m` to a static part; (M,).

    A negative margin ignores contacts up to that depth. `allowed` (P, F) are pairs that may touch.
    With `first_only` only the first such pose is marked.
    """
    found = np.zeros(len(T_world_owner), np.bool_)
    if len(moving) == 0 or len(still) == 0 or len(found) == 0:
        return found
    R, center, half = _boxes(moving, T_world_owner)
    reach = half + max(margin_m, 0.0)
    low, high = center - reach, center + reach
    rows = still.within(low.min(axis=(0, 1)), high.max(axis=(0, 1)))
    if len(rows) == 0:
        return found
    near_low, near_high = still.low_m[rows], still.high_m[rows]
    overlap = (low[:, :, None, 0] <= near_high[:, 0]) & (high[:, :, None, 0] >= near_low[:, 0])
    for axis in (1, 2):
        overlap &= low[:, :, None, axis] <= near_high[:, axis]
        overlap &= high[:, :, None, axis] >= near_low[:, axis]
    if allowed is not None:
        overlap &= ~allowed[:, rows]
    m, p, f = np.unravel_index(np.flatnonzero(overlap), overlap.shape)  # twice as fast as nonzero
    if len(m) == 0:
        return found
    # The same boxes along the moving part's own axes: this drops most pairs of long, tilted parts.
    middle, extent = (near_high + near_low)[f] / 2, (near_high - near_low)[f] / 2
    axes = R[m, p]
    away = np.abs(np.matmul((middle - center[m, p])[:, None, :], axes)[:, 0])
    size = np.matmul(extent[:, None, :], np.abs(axes))[:, 0] + moving.half_m[p] + max(margin_m, 0.0)
    keep = (away <= size).all(axis=1)
    m, p, f = m[keep], p[keep], rows[f[keep]]
    request, result = coal.CollisionRequest(), coal.CollisionResult()
    request.security_margin = margin_m
    at, touched, pose = (-1, -1), -1, None
    axes, at_m = axes[keep], T_world_owner[m, moving.owner[p], :3, 3]
    for n, (i, j, k) in enumerate(zip(m.tolist(), p.tolist(), f.tolist(), strict=True)):
        if i == touched:
            continue
        if at != (i, j):
            pose, at = coal.Transform3s(axes[n], at_m[n]), (i, j)
        result.clear()
        if coal.collide(moving.shapes[j](), pose, still.shapes[k](), still.poses[k], request, result):
            found[i], touched = True, i
            if first_only:
                break
    return found


def smallest_gap_m(moving: Hulls, T_world_owner: F64, still: Placed, far_m: float, allowed: Bools) -> float:
    """The smallest distance over M poses (M, O, 4, 4), at most `far_m`; 0 where parts touch."""
    best = far_m
    if len(moving) == 0 or len(still) == 0 or len(T_world_owner) == 0:
        return best
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    for bound, i, j, k in _nearest_boxes(moving, T_world_owner, still, far_m, allowed):
        if bound >= best:
            break
        result.clear()
        pose = _transform(T_world_owner[i, moving.owner[j]])
        gap = coal.distance(moving.shapes[j](), pose, still.shapes[k](), still.poses[k], request, result)
        best = min(best, max(gap, 0.0))
    return best


def _nearest_boxes(
    moving: Hulls, T_world_owner: F64, still: Placed, far_m: float, allowed: Bools
) -> Iterator[tuple[float, int, int, int]]:
    """Distance of the boxes, and pose, moving part and still part, nearest boxes first."""
    _, center, half = _boxes(moving, T_world_owner)
    rows = still.within((center - half).min(axis=(0, 1)) - far_m, (center + half).max(axis=(0, 1)) + far_m)
    low, high = still.low_m[rows], still.high_m[rows]
    middle, extent = (low + high) / 2, (high - low) / 2
    apart = np.abs(center[:, :, None] - middle) - half[:, :, None] - extent
    bound = np.linalg.norm(np.maximum(apart, 0.0), axis=3)
    bound[:, allowed[:, rows]] = np.inf
    m, p, f = np.nonzero(bound < far_m)
    order = np.argsort(bound[m, p, f], kind="stable")
    for i, j, k in zip(m[order].tolist(), p[order].tolist(), f[order].tolist(), strict=True):
        yield float(bound[i, j, k]), i, j, int(rows[k])


def _boxes(moving: Hulls, T_world_owner: F64) -> tuple[F64, F64, F64]:
    """Rotations (M, P, 3, 3), world centres and half sizes (M, P, 3) of the parts' boxes."""
    T = T_world_owner[:, moving.owner]
    R = T[..., :3, :3]
    center = np.matmul(R, moving.center_m[:, :, None])[..., 0] + T[..., :3, 3]
    half = np.matmul(np.abs(R), moving.half_m[:, :, None])[..., 0]
    return R, center, half


def _transform(T: F64) -> Any:
    return coal.Transform3s(np.ascontiguousarray(T[:3, :3]), T[:3, 3])

"""Clearance of a robot's body at base positions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.planar import (
    convex_hull,
    following,
    inside_any,
    polygons_at,
    signed_distances_between,
    signed_distances_to_convex,
    stack_polygons,
)
from datagen.workers.houses.house import House

# Obstacles lower than this are ignored, and floors are below it.
STEP_M = 0.02
# Clearances are capped at this: only the neighbourhood is checked.
FAR_M = 1.0
_BLOCK = 64  # footprints per block; bounds memory
_PAIRS = 4096  # of bases and obstacles, likewise
_SLACK_M = 1e-6  # more than distances are rounded by

Bools = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Obstacles:
    """Part of a house's floor plan: one convex footprint per body part, with its height range."""

    polygons_m: F64  # (P, K, 2), counter-clockwise, padded by repeating the last corner
    low_m: F64  # (P,)
    high_m: F64  # (P,)
    floors_m: tuple[F64, ...]  # room polygons


class HouseObstacles:
    """Every convex part of a house that rises above the floor; few are near a scene and need a footprint."""

    def __init__(self, house: House) -> None:
        self._parts_m, self._footprints = house.parts_m, dict[int, F64]()
        self._floors_m = tuple(room.polygon_m for room in house.rooms)
        self._low_m, self._high_m = (corners_m.astype(np.float64) for corners_m in house.part_boxes_m)

    def near(self, xy_m: F64, highest_m: float, around_m: float) -> Obstacles:
        """Those that begin below `highest_m` and may be within `around_m` of positions (N, 2)."""
        low_m, high_m, known = self._low_m, self._high_m, self._footprints
        near = (high_m[:, :2] > xy_m.min(0) - around_m).all(1) & (high_m[:, 2] > STEP_M)
        near &= (low_m[:, :2] < xy_m.max(0) + around_m).all(1) & (low_m[:, 2] < highest_m)
        rows = np.flatnonzero(near)
        for k in rows.tolist():
            if k not in known:
                known[k] = convex_hull(self._parts_m[k][:, :2])
        polygons_m = stack_polygons([known[k] for k in rows.tolist()])
        return Obstacles(polygons_m, low_m[rows, 2], high_m[rows, 2], self._floors_m)


class Footprint:
    """The outline of a base around its mount, x ahead: the convex hull of corners (K, 2)."""

    def __init__(self, corners_m: npt.ArrayLike) -> None:
        self.polygon_m = convex_hull(np.asarray(corners_m, np.float64))
        self.outer_m = float(np.linalg.norm(self.polygon_m, axis=1).max())
        along = following(self.polygon_m) - self.polygon_m
        aside = along[:, 1] * self.polygon_m[:, 0] - along[:, 0] * self.polygon_m[:, 1]
        # Radius of the circle around the mount that it holds.
        self.inner_m = np.float64((aside / np.linalg.norm(along, axis=1)).min())

    def holds(self, corners_m: npt.ArrayLike | None, radius_m: float, slack_m: float) -> bool:
        """Whether a base with these corners (K, 2), or without corners this circle, lies in it."""
        if corners_m is None:
            return bool(self.inner_m >= radius_m - slack_m)
        found = signed_distances_to_convex(np.asarray(corners_m, np.float64), self.polygon_m[None])
        return bool((found <= slack_m).all())

    def distances_m(
        self, xy_m: F64, yaw_rad: F64, polygons_m: F64, distance_m: F64, counts: Bools, only_signs: bool
    ) -> F64:
        """Distances (N, P) of the base at poses (N, 2), (N,) from obstacles (P, K, 2); negative: how deep.

        `distance_m` (N, P) are those of the mount. Where another obstacle that `counts` (P,) is nearer for
        sure, or `FAR_M` is, they are only lower bounds. With `only_signs` they all are: of those that count
        one is negative where the base hits any.
        """
        found = distance_m - self.outer_m
        nearest = (distance_m[:, counts] - self.inner_m).min(1, initial=FAR_M)
        if only_signs:  # it hits one for sure, or what is near decides
            nearest = np.where(nearest < -_SLACK_M, -np.inf, _SLACK_M)
        pose, obstacle = np.nonzero(found <= nearest[:, None])
        at = polygons_at(self.polygon_m, xy_m, yaw_rad)
        for start in range(0, len(pose), _PAIRS):
            rows = pose[start : start + _PAIRS], obstacle[start : start + _PAIRS]
            found[rows] = signed_distances_between(at[rows[0]], polygons_m[rows[1]], only_signs)
        return found


@dataclass(frozen=True, eq=False)
class ObstacleDistances:
    """Distances of N positions from the obstacles around them, computed once for robots of any size."""

    distance_m: F64  # (N, P), negative inside; only for obstacles near any of the positions
    low_m: F64  # (P,)
    high_m: F64  # (P,)
    indoors: Bools  # (N,)
    base_m: F64 | None = None  # (N, P), of a base's polygon; None where bases are circles

    @staticmethod
    def unknown(n: int, obstacles: Obstacles, has_polygon: bool) -> ObstacleDistances:
        """Room for the distances of n positions from P obstacles."""
        shape, low_m, high_m = (n, len(obstacles.low_m)), obstacles.low_m, obstacles.high_m
        base_m = np.empty(shape) if has_polygon else None
        return ObstacleDistances(np.empty(shape), low_m, high_m, np.empty(n, np.bool_), base_m)

    def at(self, rows: npt.NDArray[np.int64]) -> ObstacleDistances:
        """Those of some positions."""
        base_m = None if self.base_m is None else self.base_m[rows]
        return replace(self, distance_m=self.distance_m[rows], indoors=self.indoors[rows], base_m=base_m)

    def clearance_m(
        self,
        base_height_m: F32 | np.float32,
        camera_height_m: F32 | np.float32,
        base_radius_m: F64 | np.float64,
        mast_radius_m: float,
    ) -> F32:
        """Clearance (N,) of robots' bodies, metres; each size is a scalar or one value per position (N,)."""
        mount_m, camera_m, base_m = (
            np.broadcast_to(np.asarray(size, np.float64), len(self.distance_m))[:, None]
            for size in (base_height_m, camera_height_m, base_radius_m)
        )
        top_m = np.maximum(camera_m, mount_m)
        from_base = self.distance_m - base_m if self.base_m is None else self.base_m
        around_base = np.where(self.low_m < mount_m, from_base, FAR_M)
        hits_mast = (self.low_m < top_m) & (self.high_m > mount_m)
        around_mast = np.where(hits_mast, self.distance_m - mast_radius_m, FAR_M)
        clearance = np.minimum(around_base, around_mast).min(1, initial=FAR_M)
        clearance = np.where(self.indoors, clearance, np.minimum(clearance, -base_m[:, 0]))
        return clearance.astype(np.float32)


def distances_from_obstacles(
    xy_m: F64,
    obstacles: Obstacles,
    footprint: Footprint | None = None,
    yaw_rad: F32 | None = None,
    lowest_mount_m: float = 0.0,
    only_signs: bool = False,
) -> ObstacleDistances:
    """Distances of positions (N, 2), world, from obstacles.

    A `footprint` has headings (N,), and mounts from `lowest_mount_m` on. With `only_signs` its distances are
    only as exact as it takes to say whether it hits an obstacle.
    """
    polygons_m, low_m, base_m = obstacles.polygons_m, obstacles.low_m, None
    blocks = (
        signed_distances_to_convex(xy_m, polygons_m[start : start + _BLOCK])
        for start in range(0, len(polygons_m), _BLOCK)
    )
    distance_m = np.concatenate([np.empty((len(xy_m), 0)), *blocks], axis=1)
    indoors = inside_any(xy_m, obstacles.floors_m)
    if footprint is not None and yaw_rad is not None:
        heading, counts = yaw_rad.astype(np.float64), low_m < lowest_mount_m
        base_m = footprint.distances_m(xy_m, heading, polygons_m, distance_m, counts, only_signs)
    return ObstacleDistances(distance_m, low_m, obstacles.high_m, indoors, base_m)


def base_clearance_m(
    base_xy_m: F32,
    base_height_m: F32,
    camera_height_m: F32,
    base_radius_m: F64,
    obstacles: HouseObstacles,
    mast_radius_m: float,
    footprint: Footprint | None = None,
    yaw_rad: F32 | None = None,
) -> F32:
    """Clearance (N,) of robots' bodies (m); negative inside an obstacle or outside every room.

    Robot k is at `base_xy_m` (N, 2), world, with its arm's mount and its camera at the heights
        (N,). Its body is a cylinder of `base_radius_m` (N,) from the floor to the mount and a mast of
        `mast_radius_m` from there to the camera. An obstacle counts against the cylinder where it
        begins below the mount, and against the mast where it lies between mount and camera. With a
        `footprint` the body is a prism with this outline at headings (N,), in place of the cylinder.
    """
    top_m = float(np.maximum(camera_height_m, base_height_m).max())
    outer_m = float(base_radius_m.max()) if footprint is None else footprint.outer_m
    xy_m, lowest_m = base_xy_m.astype(np.float64), float(base_height_m.min())
    near = obstacles.near(xy_m, top_m, FAR_M + max(outer_m, mast_radius_m))
    around = distances_from_obstacles(xy_m, near, footprint, yaw_rad, lowest_m)
    return around.clearance_m(base_height_m, camera_height_m, base_radius_m, mast_radius_m)

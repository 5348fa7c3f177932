"""Clearance of a robot's body at base positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.planar import (
    convex_hull,
    inside_any,
    signed_distances_to_convex,
    stack_polygons,
)
from datagen.workers.houses.house import House

# Obstacles lower than this are ignored, and floors are below it.
STEP_M = 0.02
# Clearances are capped at this: only the neighbourhood is checked.
FAR_M = 1.0
_BLOCK = 64  # footprints per block; bounds memory


@dataclass(frozen=True, eq=False)
class Obstacles:
    """Floor plan of a house: one convex footprint per body part, with its height range."""

    polygons_m: F64  # (P, K, 2), counter-clockwise, padded by repeating the last corner
    low_m: F64  # (P,)
    high_m: F64  # (P,)
    floors_m: tuple[F64, ...]  # room polygons


def obstacles_of(house: House) -> Obstacles:
    """Footprints of every convex part of the house that rises above the floor."""
    low_m, high_m = (corners_m[:, 2] for corners_m in house.part_boxes_m)
    rows = np.flatnonzero(high_m > STEP_M)
    return Obstacles(
        polygons_m=stack_polygons([convex_hull(house.parts_m[k][:, :2]) for k in rows]),
        low_m=low_m[rows].astype(np.float64),
        high_m=high_m[rows].astype(np.float64),
        floors_m=tuple(room.polygon_m for room in house.rooms),
    )


@dataclass(frozen=True, eq=False)
class ObstacleDistances:
    """Distances of N positions from the obstacles around them, computed once for robots of any size."""

    distance_m: F64  # (N, P), negative inside; only for obstacles near any of the positions
    low_m: F64  # (P,)
    high_m: F64  # (P,)
    indoors: npt.NDArray[np.bool_]  # (N,)

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
        around_base = np.where(self.low_m < mount_m, self.distance_m - base_m, FAR_M)
        hits_mast = (self.low_m < top_m) & (self.high_m > mount_m)
        around_mast = np.where(hits_mast, self.distance_m - mast_radius_m, FAR_M)
        clearance = np.minimum(around_base, around_mast).min(1, initial=FAR_M)
        clearance = np.where(self.indoors, clearance, np.minimum(clearance, -base_m[:, 0]))
        return clearance.astype(np.float32)


def distances_from_obstacles(
    xy_m: F64, obstacles: Obstacles, highest_m: float, around_m: float
) -> ObstacleDistances:
    """Distances of positions (N, 2), world, from obstacles that begin below `highest_m`.

    Obstacles farther than `around_m` from all positions may be left out.
    """
    near = (obstacles.polygons_m.max(1) > xy_m.min(0) - around_m).all(1)
    near &= (obstacles.polygons_m.min(1) < xy_m.max(0) + around_m).all(1)
    near &= obstacles.low_m < highest_m
    rows = np.flatnonzero(near)
    blocks = (
        signed_distances_to_convex(xy_m, obstacles.polygons_m[rows[start : start + _BLOCK]])
        for start in range(0, len(rows), _BLOCK)
    )
    distance_m = np.concatenate([np.empty((len(xy_m), 0)), *blocks], axis=1)
    indoors = inside_any(xy_m, obstacles.floors_m)
    return ObstacleDistances(distance_m, obstacles.low_m[rows], obstacles.high_m[rows], indoors)


def base_clearance_m(
    base_xy_m: F32,
    base_height_m: F32,
    camera_height_m: F32,
    base_radius_m: F64,
    obstacles: Obstacles,
    mast_radius_m: float,
) -> F32:
    """Clearance (N,) of robots' bodies (m); negative inside an obstacle or outside every room.

    Robot k is at `base_xy_m` (N, 2), world, with its arm's mount and its camera at the heights
        (N,). Its body is a cylinder of `base_radius_m` (N,) from the floor to the mount and a mast of
        `mast_radius_m` from there to the camera. An obstacle counts against the cylinder where it
        begins below the mount, and against the mast where it lies between mount and camera.
    """
    top_m = float(np.maximum(camera_height_m, base_height_m).max())
    around_m = FAR_M + max(float(base_radius_m.max()), mast_radius_m)
    around = distances_from_obstacles(base_xy_m.astype(np.float64), obstacles, top_m, around_m)
    return around.clearance_m(base_height_m, camera_height_m, base_radius_m, mast_radius_m)

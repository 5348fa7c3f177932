"""Clearance of a robot's body at base positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datagen.schemas.specification import CandidateParams
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
    parts = [p for body in house.bodies for p in body.convex_parts_m if p[:, 2].max() > STEP_M]
    return Obstacles(
        polygons_m=stack_polygons([convex_hull(p[:, :2].astype(np.float64)) for p in parts]),
        low_m=np.array([p[:, 2].min() for p in parts], np.float64),
        high_m=np.array([p[:, 2].max() for p in parts], np.float64),
        floors_m=tuple(room.polygon_m for room in house.rooms),
    )


def base_clearance_m(
    base_xy_m: F32, base_height_m: F32, camera_height_m: F32, obstacles: Obstacles, params: CandidateParams
) -> F32:
    """Clearance (N,) of robots' bodies (m); negative inside an obstacle or outside every room.

    Robot k is at `base_xy_m` (N, 2), world, with its arm's mount and its camera at the heights
        (N,). Its body is a cylinder of `base_radius_m` from the floor to the mount and a mast of
        `mast_radius_m` from there to the camera. An obstacle counts against the cylinder where it
        begins below the mount, and against the mast where it lies between mount and camera.
    """
    xy = base_xy_m.astype(np.float64)
    mount_m = base_height_m.astype(np.float64)
    top_m = np.maximum(camera_height_m, base_height_m).astype(np.float64)
    clearance = np.full(len(xy), FAR_M)
    reach = FAR_M + max(params.base_radius_m, params.mast_radius_m)
    near = (obstacles.polygons_m.max(1) > xy.min(0) - reach).all(1)
    near &= (obstacles.polygons_m.min(1) < xy.max(0) + reach).all(1)
    near &= obstacles.low_m < top_m.max()
    rows = np.flatnonzero(near)
    for start in range(0, len(rows), _BLOCK):
        k = rows[start : start + _BLOCK]
        distance = signed_distances_to_convex(xy, obstacles.polygons_m[k])  # (N, B)
        low, high = obstacles.low_m[k], obstacles.high_m[k]
        hits_base = low < mount_m[:, None]
        hits_mast = (low < top_m[:, None]) & (high > mount_m[:, None])
        around_base = np.where(hits_base, distance - params.base_radius_m, FAR_M)
        around_mast = np.where(hits_mast, distance - params.mast_radius_m, FAR_M)
        clearance = np.minimum(clearance, np.minimum(around_base, around_mast).min(1))
    indoors = inside_any(xy, obstacles.floors_m)
    clearance = np.where(indoors, clearance, np.minimum(clearance, -params.base_radius_m))
    return clearance.astype(np.float32)

"""Whether a robot's body fits where it would stand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from schemas.specification import CandidateParams
from workers.geometry.mesh import F32, F64
from workers.geometry.planar import convex_hull, inside_any, signed_distance_to_convex
from workers.houses.house import House
from workers.labels.candidates import Candidates

# A base rolls over what is flatter than this, and floors lie below it.
STEP_M = 0.02


@dataclass(frozen=True, eq=False)
class Obstacles:
    """Floor plan of a house: one convex footprint a body part, with the heights it spans."""

    polygons_m: tuple[F64, ...]  # each (K, 2), counter-clockwise
    low_m: F64  # (P,)
    high_m: F64  # (P,)
    xy_min_m: F64  # (P, 2), bounding boxes of the footprints
    xy_max_m: F64  # (P, 2)
    floors_m: tuple[F64, ...]  # room polygons


def obstacles_of(house: House) -> Obstacles:
    """Footprints of every convex part of the house that rises above the floor."""
    parts = [p for body in house.bodies for p in body.convex_parts_m if p[:, 2].max() > STEP_M]
    polygons = tuple(convex_hull(p[:, :2].astype(np.float64)) for p in parts)
    return Obstacles(
        polygons_m=polygons,
        low_m=np.array([p[:, 2].min() for p in parts], np.float64),
        high_m=np.array([p[:, 2].max() for p in parts], np.float64),
        xy_min_m=np.array([p.min(0) for p in polygons]).reshape(-1, 2),
        xy_max_m=np.array([p.max(0) for p in polygons]).reshape(-1, 2),
        floors_m=tuple(room.polygon_m for room in house.rooms),
    )


def base_clearance_m(candidates: Candidates, obstacles: Obstacles, params: CandidateParams) -> F32:
    """Free distance (N,) around a robot's body; negative where it cuts an obstacle or stands in no room.

    The body is a cylinder of `base_radius_m` from the floor to the arm's mount and a mast of
    `mast_radius_m` from there to the camera. An obstacle counts against the cylinder where it
    begins below the mount, and against the mast where it lies between mount and camera. Values
    beyond 1 m are cut to 1 m: only the neighbourhood is looked at.
    """
    far_m = 1.0
    xy = candidates.base_xy_m.astype(np.float64)
    clearance = np.full(len(xy), far_m)
    top_m = np.maximum(candidates.camera_height_m, candidates.base_height_m)
    reach = far_m + max(params.base_radius_m, params.mast_radius_m)
    near = ((obstacles.xy_max_m > xy.min(0) - reach) & (obstacles.xy_min_m < xy.max(0) + reach)).all(1)
    near &= obstacles.low_m < top_m.max()
    for k in np.flatnonzero(near):
        distance = signed_distance_to_convex(xy, obstacles.polygons_m[k])
        hits_base = obstacles.low_m[k] < candidates.base_height_m
        hits_mast = (obstacles.low_m[k] < top_m) & (obstacles.high_m[k] > candidates.base_height_m)
        clearance = np.minimum(clearance, np.where(hits_base, distance - params.base_radius_m, far_m))
        clearance = np.minimum(clearance, np.where(hits_mast, distance - params.mast_radius_m, far_m))
    indoors = inside_any(xy, obstacles.floors_m)
    clearance = np.where(indoors, clearance, np.minimum(clearance, -params.base_radius_m))
    return clearance.astype(np.float32)

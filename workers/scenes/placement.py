"""Where target and clutter are dropped: on one support, without overlap."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from datagen.schemas.specification import SceneParams
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.planar import convex_hull
from datagen.workers.geometry.transforms import yaw_pose
from datagen.workers.houses.house import House, Surface
from datagen.workers.objects.model import ObjectModel
from datagen.workers.scene_rejected import SceneRejected

_GAP_M = 0.004  # kept between things that are dropped side by side
_NEAR_TRIES, _FAR_TRIES = 36, 40
_ABOVE_M = 0.5  # things this far above the surface cannot be in the way of a drop


def eligible_surfaces(house: House, params: SceneParams) -> list[Surface]:
    """Surfaces of the asked height on which a target and some clutter find room."""
    low, high = params.support_height_m.low, params.support_height_m.high
    return [s for s in house.surfaces if low <= s.height_m <= high and min(s.size_m) >= 0.3]


def standing_footprints(house: House, surface: Surface) -> list[F64]:
    """Convex footprints (K, 2), surface frame, of what already rises above the surface."""
    T = surface.T_world_surface
    half = np.array(surface.size_m) / 2
    footprints = []
    for part in nearby_parts(house, surface, margin_m=0.0):
        local = (part.astype(np.float64) - T[:3, 3]) @ T[:3, :3]
        if local[:, 2].max() > 0.005 and local[:, 2].min() < _ABOVE_M:
            outline = local[:, :2]
            if (outline.max(0) > -half).all() and (outline.min(0) < half).all():
                footprints.append(convex_hull(outline))
    return footprints


def nearby_parts(house: House, surface: Surface, margin_m: float) -> list[F32]:
    """Convex parts whose bounding boxes come within `margin_m` of the space around the surface.

    That space reaches from the floor to half a metre above the surface, over its rectangle.
    """
    T = surface.T_world_surface
    reach = np.abs(T[:2, :2]) @ (np.array(surface.size_m) / 2) + margin_m
    low = np.array([*(T[:2, 3] - reach), -1.0])
    high = np.array([*(T[:2, 3] + reach), surface.height_m + _ABOVE_M])
    parts = (p for body in house.bodies for p in body.convex_parts_m)
    return [p for p in parts if (p.max(0) >= low).all() and (p.min(0) <= high).all()]


def drop_poses(
    models: Sequence[ObjectModel],
    surface: Surface,
    taken: Sequence[F64],
    params: SceneParams,
    rng: np.random.Generator,
) -> F64:
    """Start poses (K, 4, 4), world: upright, turned at random, just above the surface, disjoint.

    Object 0, the target, goes anywhere; the others within `clutter_radius_m` of it, then up to
    twice as far, and anywhere once that is full.
    `taken` are footprints in the surface frame that are kept free. Raises SceneRejected("no_placement").
    """
    half = np.array(surface.size_m) / 2 - params.edge_margin_m
    placed: list[F64] = [np.asarray(p) for p in taken]
    low = np.array([p.min(0) for p in placed]).reshape(-1, 2)
    high = np.array([p.max(0) for p in placed]).reshape(-1, 2)
    poses = np.empty((len(models), 4, 4))
    target_xy = np.zeros(2)
    for k, model in enumerate(models):
        tries = _FAR_TRIES if k == 0 else _NEAR_TRIES + _FAR_TRIES
        for attempt in range(tries):
            yaw = rng.uniform(-np.pi, np.pi)
            if k > 0 and attempt < _NEAR_TRIES:
                # The ring widens with every try, so that a crowded middle is left step by step.
                reach_m = params.clutter_radius_m * (1 + attempt / _NEAR_TRIES)
                angle, radius = rng.uniform(-np.pi, np.pi), rng.uniform(0, reach_m)
                xy = target_xy + radius * np.array([np.cos(angle), np.sin(angle)])
            else:
                xy = rng.uniform(-half, half)
            outline = _outline(model, xy, yaw)
            on_surface = (np.abs(outline) <= half).all()
            if on_surface and not any(_overlap(outline, placed[i]) for i in _boxes_meet(outline, low, high)):
                break
        else:
            raise SceneRejected("no_placement")
        if k == 0:
            target_xy = xy
        placed.append(outline)
        low, high = np.vstack([low, outline.min(0)]), np.vstack([high, outline.max(0)])
        height_m = model.size_m[2] / 2 + params.drop_height_m
        poses[k] = surface.T_world_surface @ yaw_pose(xy[0], xy[1], height_m, yaw)
    return poses


def _outline(model: ObjectModel, xy: F64, yaw: float) -> F64:
    """Bounding rectangle (4, 2) of an object, turned and moved, with half the gap around it."""
    x, y = model.size_m[0] / 2 + _GAP_M / 2, model.size_m[1] / 2 + _GAP_M / 2
    c, s = np.cos(yaw), np.sin(yaw)
    corners = np.array([[-x, -y], [x, -y], [x, y], [-x, y]])
    return corners @ np.array([[c, s], [-s, c]]) + xy


def _boxes_meet(outline: F64, low: F64, high: F64) -> npt.NDArray[np.intp]:
    """Rows of the bounding boxes from `low` to `high`, each (P, 2), that meet the outline's own."""
    return np.flatnonzero(((outline.max(0) >= low) & (outline.min(0) <= high)).all(1))


def _overlap(a: F64, b: F64) -> bool:
    """Whether two convex polygons (K, 2) overlap, by the separating axis theorem."""
    for polygon in (a, b):
        edges = np.roll(polygon, -1, axis=0) - polygon
        normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
        on_a, on_b = normals @ a.T, normals @ b.T
        if ((on_a.max(1) < on_b.min(1)) | (on_b.max(1) < on_a.min(1))).any():
            return False
    return True

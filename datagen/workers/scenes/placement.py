"""Drop poses of target and clutter on one support, without overlap."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from datagen.schemas.fields import REDRAW_CAUSES
from datagen.schemas.specification import SceneParams
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.planar import convex_hull, following, stack_polygons
from datagen.workers.geometry.transforms import yaw_pose
from datagen.workers.houses.house import House, Surface
from datagen.workers.objects.model import ObjectModel


class SceneRejected(Exception):
    """The scene is rejected and resampled; `cause` is one of REDRAW_CAUSES, `detail` optional text."""

    def __init__(self, cause: str, detail: str = "") -> None:
        if cause not in REDRAW_CAUSES:
            raise KeyError(f"unknown redraw cause {cause!r}; causes are {', '.join(REDRAW_CAUSES)}")
        super().__init__(cause)
        self.cause = cause
        self.detail = detail


_GAP_M = 0.004  # kept between objects that are dropped side by side
_NEAR_TRIES, _FAR_TRIES = 36, 40
_BLOCK = 8  # tries that are checked together; the first few mostly suffice
_ABOVE_M = 0.5  # objects this far above the surface do not block a drop

Bools = npt.NDArray[np.bool_]


def eligible_surfaces(house: House, params: SceneParams) -> list[Surface]:
    """Surfaces of the specified height with room for a target and some clutter."""
    low, high = params.support_height_m.low, params.support_height_m.high
    return [s for s in house.surfaces if low <= s.height_m <= high and min(s.size_m) >= 0.3]


def describe_surfaces(house: House, params: SceneParams) -> str:
    """The surfaces of a house without an eligible one, for an error: their heights and sizes."""
    wanted = params.support_height_m
    found = "no surface"
    if house.surfaces:
        heights_m = [surface.height_m for surface in house.surfaces]
        widest_m = max(min(surface.size_m) for surface in house.surfaces)
        found = f"surfaces at {min(heights_m):.2f} to {max(heights_m):.2f} m, up to {widest_m:.2f} m wide"
    return f"{house.house_id} with {found}, not at {wanted.low:g} to {wanted.high:g} m and 0.3 m wide"


def standing_footprints(house: House, surface: Surface) -> list[F64]:
    """Convex footprints (K, 2), surface frame, of parts that rise above the surface."""
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
    part_low, part_high = house.part_boxes_m
    near = ((part_high >= low) & (part_low <= high)).all(1)
    return [house.parts_m[k] for k in np.flatnonzero(near)]


def drop_poses(
    models: Sequence[ObjectModel],
    surface: Surface,
    taken: Sequence[F64],
    params: SceneParams,
    rng: np.random.Generator,
) -> F64:
    """Start poses (K, 4, 4), world: upright, turned at random, just above the surface, disjoint.

    Object 0, the target, is placed anywhere; the others within `clutter_radius_m` of it, then up to
    twice as far, and anywhere once that is full.
    `taken` are footprints in the surface frame that are kept free. Raises SceneRejected("no_placement").
    """
    half = np.array(surface.size_m) / 2 - params.edge_margin_m
    placed: list[F64] = [np.asarray(p) for p in taken]
    poses = np.empty((len(models), 4, 4))
    target_xy = np.zeros(2)
    for k, model in enumerate(models):
        near_tries = 0 if k == 0 else _NEAR_TRIES
        footprints = stack_polygons([*placed, np.zeros((4, 2))])[:-1]  # at least four corners each
        state = rng.bit_generator.state
        # Each try uses three numbers of the stream: the yaw, then angle and radius, or x and y.
        numbers = rng.random((near_tries + _FAR_TRIES, 3))
        positions = _positions(numbers, near_tries, half, target_xy, params.clutter_radius_m)
        outlines = _outlines(model, positions, _between(-np.pi, np.pi, numbers[:, 0]))
        attempt = _first_free(outlines, half, footprints)
        if attempt is None:
            raise SceneRejected("no_placement")
        # The random numbers of later tries are not consumed.
        rng.bit_generator.state = state
        rng.random((attempt + 1, 3))
        xy, yaw = positions[attempt], float(_between(-np.pi, np.pi, numbers[attempt, 0]))
        if k == 0:
            target_xy = xy
        placed.append(outlines[attempt])
        height_m = model.size_m[2] / 2 + params.drop_height_m
        poses[k] = surface.T_world_surface @ yaw_pose(float(xy[0]), float(xy[1]), height_m, yaw)
    return poses


def _positions(numbers: F64, near_tries: int, half: F64, target_xy: F64, radius_m: float) -> F64:
    """Positions (T, 2) of the tries: the first `near_tries` around the target, the others anywhere."""
    near, far = numbers[:near_tries], numbers[near_tries:]
    # The ring widens with every try, so that a crowded middle is left step by step.
    reach_m = radius_m * (1 + np.arange(near_tries) / _NEAR_TRIES)
    angle, apart_m = _between(-np.pi, np.pi, near[:, 1]), 0.0 + (reach_m - 0.0) * near[:, 2]
    around = target_xy + apart_m[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([around, _between(-half, half, far[:, 1:])])


def _between(low: F64 | float, high: F64 | float, numbers: F64 | np.float64) -> F64:
    """Random numbers in [0, 1) scaled to [low, high), as `Generator.uniform` does."""
    return np.asarray(low + (high - low) * numbers)


def _outlines(model: ObjectModel, xy: F64, yaw: F64) -> F64:
    """Bounding rectangles (T, 4, 2) of an object at the tries' poses, with half the gap around it."""
    x, y = model.size_m[0] / 2 + _GAP_M / 2, model.size_m[1] / 2 + _GAP_M / 2
    c, s = np.cos(yaw), np.sin(yaw)
    corners = np.array([[-x, -y], [x, -y], [x, y], [-x, y]])
    rotations = np.array([[c, s], [-s, c]]).transpose(2, 0, 1)
    return corners @ rotations + xy[:, None]


def _first_free(outlines: F64, half: F64, footprints: F64) -> int | None:
    """Index of the first rectangle (T, 4, 2) on the surface that overlaps no footprint (P, K, 2)."""
    on_surface = np.flatnonzero((np.abs(outlines) <= half).all((1, 2)))
    for start in range(0, len(on_surface), _BLOCK):
        rows = on_surface[start : start + _BLOCK]
        free = np.flatnonzero(~_overlap(outlines[rows], footprints).any(1))
        if len(free):
            return int(rows[free[0]])
    return None


def _overlap(a: F64, b: F64) -> Bools:
    """Whether convex polygons (T, J, 2) and (P, K, 2) overlap (T, P), by the separating axis theorem."""
    return ~(_separated(a, b) | _separated(b, a).T)


def _separated(a: F64, b: F64) -> Bools:
    """Whether a side of polygon a (T, J, 2) separates it from polygon b (P, K, 2); (T, P)."""
    edges = following(a) - a
    normals = np.stack([edges[..., 1], -edges[..., 0]], axis=2)  # (T, J, 2), outward
    on_a = normals @ a.transpose(0, 2, 1)  # (T, J, J)
    on_b = (normals.reshape(-1, 2) @ b.reshape(-1, 2).T).reshape(*normals.shape[:2], *b.shape[:2])
    beyond = (on_a.max(2)[..., None] < on_b.min(3)) | (on_b.max(3) < on_a.min(2)[..., None])
    return beyond.any(1)

"""Drop poses of target and clutter on one support, without overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from datagen.schemas.fields import REDRAW_CAUSES
from datagen.schemas.specification import PLACE_KINDS, PlaceKind, SceneParams
from datagen.workers.furniture.places import NARROWEST_M
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.planar import convex_hull, following, inside_polygon, stack_polygons
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
_ABOVE_M = 0.5  # parts this far above a top do not block a drop
_OVER_M = 0.02  # kept above objects that are dropped below a board

Bools = npt.NDArray[np.bool_]


def draw_place(params: SceneParams, rng: np.random.Generator) -> tuple[PlaceKind, bool]:
    """The kind of place of a scene, by its weight, and whether the scene is to be decisive."""
    kind, number = rng.random(2)
    weights = {"top": 1.0} if params.places is None else params.places.weights()
    shares = np.cumsum(list(weights.values()))
    chosen = PLACE_KINDS[int(np.searchsorted(shares, kind * shares[-1], side="right"))]
    return chosen, params.decisive is not None and bool(number < params.decisive)


def eligible_surfaces(house: House, params: SceneParams, kind: PlaceKind = "top") -> list[Surface]:
    """Surfaces of a kind with room for a target, at the specified height where they are not the floor."""
    low, high = params.support_height_m.low, params.support_height_m.high
    narrowest_m = 0.3 if kind == "top" else NARROWEST_M
    return [
        s
        for s in house.surfaces
        if s.kind == kind and (kind == "floor" or low <= s.height_m <= high) and min(s.size_m) >= narrowest_m
    ]


def describe_surfaces(house: House, params: SceneParams, kind: PlaceKind = "top") -> str:
    """The surfaces of a house without an eligible one, for an error: their heights and sizes."""
    wanted = params.support_height_m
    surfaces = [surface for surface in house.surfaces if surface.kind == kind]
    found = "no surface" if kind == "top" else f"no place of kind {kind}"
    if surfaces:
        heights_m = [surface.height_m for surface in surfaces]
        widest_m = max(min(surface.size_m) for surface in surfaces)
        found = f"surfaces at {min(heights_m):.2f} to {max(heights_m):.2f} m, up to {widest_m:.2f} m wide"
    return f"{house.house_id} with {found}, not at {wanted.low:g} to {wanted.high:g} m and 0.3 m wide"


@dataclass(frozen=True, eq=False)
class Standing:
    """A part that rises above a surface: its convex footprint (K, 2), surface frame, and where it begins."""

    outline: F64
    above_m: float


def standing_parts(house: House, surface: Surface) -> list[Standing]:
    """The parts up to half a metre above the surface that rise above it."""
    T = surface.T_world_surface
    half = np.array(surface.size_m) / 2
    standing = []
    for part in nearby_parts(house, surface, margin_m=0.0):
        local = (part.astype(np.float64) - T[:3, 3]) @ T[:3, :3]
        above_m = float(local[:, 2].min())
        if local[:, 2].max() > 0.005 and above_m < _ABOVE_M:
            outline = local[:, :2]
            if (outline.max(0) > -half).all() and (outline.min(0) < half).all():
                standing.append(Standing(convex_hull(outline), above_m))
    return standing


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
    standing: Sequence[Standing],
    params: SceneParams,
    rng: np.random.Generator,
    room_m: F64 | None = None,
) -> tuple[list[int], F64]:
    """Indices (K,) of the placed objects, and their start poses (K, 4, 4), world.

    They are upright, turned at random, just above the surface, and disjoint. Object 0, the target, is placed
    anywhere; the others within `clutter_radius_m` of it, then up to twice as far, and anywhere once that is
    full. `standing` is kept free, and the outside of the polygon `room_m` (K, 2), world, if there is one.
    With `places`, objects may stand below a board that is high enough, the target is near an edge and at the
    back more often, and clutter that finds no room is left out. Raises SceneRejected("no_placement").
    """
    half = np.array(surface.size_m) / 2 - params.edge_margin_m
    placed: list[F64] = []
    kept: list[int] = []
    poses: list[F64] = []
    target_xy = np.zeros(2)
    for k, model in enumerate(models):
        near_tries = 0 if k == 0 else _NEAR_TRIES
        tall_m = _ABOVE_M if params.places is None else model.size_m[2] + params.drop_height_m + _OVER_M
        taken = [part.outline for part in standing if part.above_m < tall_m]
        footprints = stack_polygons([*taken, *placed, np.zeros((4, 2))])[:-1]  # at least four corners each
        state = rng.bit_generator.state
        # Each try uses three numbers of the stream: the yaw, then angle and radius, or x and y.
        numbers = rng.random((near_tries + _FAR_TRIES, 3))
        if k == 0 and params.places is not None:
            numbers[:, 1:] = _towards_edges(numbers[:, 1:])
        positions = _positions(numbers, near_tries, half, target_xy, params.clutter_radius_m)
        outlines = _outlines(model, positions, _between(-np.pi, np.pi, numbers[:, 0]))
        on_surface = (np.abs(outlines) <= half).all((1, 2)) & _within_room(outlines, surface, room_m)
        attempt = _first_free(outlines, np.flatnonzero(on_surface), footprints)
        if attempt is None and (k == 0 or params.places is None):
            raise SceneRejected("no_placement")
        if attempt is None:
            continue
        # The random numbers of later tries are not consumed.
        rng.bit_generator.state = state
        rng.random((attempt + 1, 3))
        xy, yaw = positions[attempt], float(_between(-np.pi, np.pi, numbers[attempt, 0]))
        if k == 0:
            target_xy = xy
        placed.append(outlines[attempt])
        height_m = model.size_m[2] / 2 + params.drop_height_m
        poses.append(surface.T_world_surface @ yaw_pose(float(xy[0]), float(xy[1]), height_m, yaw))
        kept.append(k)
    return kept, np.array(poses)


def _within_room(outlines: F64, surface: Surface, room_m: F64 | None) -> Bools:
    """Whether all corners of each outline (T, 4, 2), surface frame, lie in the room."""
    if room_m is None:
        return np.ones(len(outlines), np.bool_)
    T = surface.T_world_surface
    corners_m = outlines.reshape(-1, 2) @ T[:2, :2].T + T[:2, 3]
    return np.all(inside_polygon(corners_m, room_m).reshape(-1, 4), axis=1)


def _towards_edges(numbers: F64) -> F64:
    """Numbers (T, 2) in [0, 1), moved along x towards both ends and along y towards the back, 0."""
    x, y = numbers.T
    return np.column_stack([(1 - np.cos(np.pi * x)) / 2, y**1.5])


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


def _first_free(outlines: F64, usable: npt.NDArray[np.intp], footprints: F64) -> int | None:
    """Index of the first of the `usable` rectangles (T, 4, 2) that overlaps no footprint (P, K, 2)."""
    for start in range(0, len(usable), _BLOCK):
        rows = usable[start : start + _BLOCK]
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

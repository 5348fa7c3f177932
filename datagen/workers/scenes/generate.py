"""Sample one scene from its random streams: place, settle, sample bases, observe; retry on rejection."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.identity import Stream, generator
from datagen.schemas.run_records import StageClock
from datagen.schemas.specification import (
    PLACE_KINDS,
    CandidateParams,
    ObservationParams,
    PlaceKind,
    SettleParams,
    Specification,
)
from datagen.workers.bases.candidates import SceneCandidates, draw_candidates
from datagen.workers.bases.clearance import HouseObstacles, base_clearance_m
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.planar import inside_polygon
from datagen.workers.geometry.transforms import look_at
from datagen.workers.houses.house import Room, Surface
from datagen.workers.objects.model import ObjectModel
from datagen.workers.rendering import Camera, Frame, SceneGeometry, load_renderer
from datagen.workers.rendering.cloud import Cloud, PixelCaster, caster_of, observe_cloud
from datagen.workers.rendering.embree import RayScene, cast_pixels, ray_scene
from datagen.workers.rendering.noise import add_noise
from datagen.workers.rendering.visibility import visible_pixels
from datagen.workers.scenes import Scene
from datagen.workers.scenes.placement import (
    SceneRejected,
    describe_surfaces,
    draw_place,
    drop_poses,
    eligible_surfaces,
    nearby_parts,
    standing_parts,
)
from datagen.workers.settling import SettleResult, load_settler
from datagen.workers.world import PreparedHouse, World

if TYPE_CHECKING:
    from datagen.workers.motion.reachable_set import ReachableSet
    from datagen.workers.scenes.reconstruct import ReconstructedScene

# Objects that roll off the support touch no static part farther from it than this.
_SURROUNDINGS_M = 0.3

_OBJECTS = "Check masses, scale and collision parts of the objects"
# What each cause of a rejection means, and what may help where it is the most frequent.
_CAUSES = {
    "bad_house": ("houses cannot be used", "Correct or remove them; `submit --dry-run` names each"),
    "no_surface": (
        "houses have no support surface of the specified height and size",
        "Omit the kind in scene.places, widen scene.support_height_m, or check scale and axes of the houses",
    ),
    "no_placement": (
        "target and clutter find no free place on the surface",
        "Use smaller objects or less clutter (scene.n_clutter)",
    ),
    "not_at_rest": ("objects still move after the last step", _OBJECTS),
    "fell_off": ("objects leave their support", _OBJECTS),
    "penetration": ("objects end inside others", _OBJECTS),
    "not_finite": ("the physics returns no finite poses", _OBJECTS),
    "no_viewpoint": (
        "no free viewpoint sees enough of the target",
        "Widen observation.distance_m, or use houses with more free floor",
    ),
    "no_base": (
        "no candidate base pose around the target is clear or within reach",
        "Use --candidates grid, or widen candidates.arm_reach_m",
    ),
}


def generate_scene(
    world: World, index: int, clock: StageClock, after: Scene | None = None
) -> tuple[Scene, SceneCandidates]:
    """Sample scene `index` of the specification and its candidates: the first accepted try.

    `after` is an earlier scene of this index, which another is to replace. Raises InputError after
    `scene.max_retries` rejections.
    """
    redraws, details = Counter[str](), dict[str, str]()
    first = 0
    if after is not None:
        redraws.update(after.redraws)
        first = after.retry + 1
    for retry in range(first, first + world.spec.scene.max_retries):
        try:
            return _try_scene(world, index, retry, dict(redraws), clock)
        except SceneRejected as rejection:
            redraws[rejection.cause] += 1
            if rejection.detail:
                details[rejection.cause] = rejection.detail
    most = redraws.most_common(1)[0][0]
    counts = ", ".join(f"{cause} {count}" for cause, count in redraws.most_common())
    why, fix = _CAUSES[most]
    example = f", as {details[most]}" if most in details else ""
    problem = f"no usable scene in {world.spec.scene.max_retries} tries ({counts}): {why}{example}"
    raise InputError(f"scene {index}", "scene.max_retries", problem, fix)


def _try_scene(
    world: World, index: int, retry: int, redraws: dict[str, int], clock: StageClock
) -> tuple[Scene, SceneCandidates]:
    spec = world.spec
    with clock.stage("draw"):
        kind, _ = draw_place(spec.scene, generator(spec.seed, Stream.PLACE, index))
        rng = generator(spec.seed, Stream.SCENE, index, retry)
        house = _house_with(world, world.house_ids[rng.integers(len(world.house_ids))], kind)
        surfaces = eligible_surfaces(house.house, spec.scene, kind)
        surface = surfaces[rng.integers(len(surfaces))]
        names = _draw_names(world, rng, clock)
        standing = standing_parts(house.house, surface)
        room_m = house.house.room(surface.room_id).polygon_m if kind == "floor" else None
        kept, start = drop_poses(
            [world.object(name) for name in names], surface, standing, spec.scene, rng, room_m
        )
        models = tuple(world.object(names[k]) for k in kept)
        static = nearby_parts(house.house, surface, _SURROUNDINGS_M)

    with clock.stage("settle"):
        settled = load_settler(spec.settle.engine)(static, models, start, spec.settle)
        check_settled(settled, models, surface, spec.settle)

    target_m = settled.T_world_object[0, :3, 3]
    with clock.stage("draw"):
        rng = generator(spec.seed, Stream.CANDIDATES, index, retry)
        candidates = draw_candidates(target_m, house.obstacles, spec.candidates, rng, _reach_of(spec))
        if candidates is None:
            raise SceneRejected("no_base")

    with clock.stage("observe"):
        geometry = SceneGeometry(house.house, models, settled.T_world_object)
        rays = ray_scene(geometry)
        seen = observe(house, surface.room_id, geometry, rays, spec, (index, retry))
    scene = Scene(index, retry, redraws, house, surface, models, settled, rays, *seen)
    return scene, candidates


def observe(
    house: PreparedHouse,
    room_id: str,
    geometry: SceneGeometry,
    rays: RayScene,
    spec: Specification,
    item: tuple[int, ...],
) -> tuple[Camera, float, Callable[[], Cloud]]:
    """A camera in the room, the share of the target that it sees, and a function that draws its cloud.

    `item` is the scene's index and retry, and the number of the viewpoint where it is not the first. Raises
    SceneRejected("no_viewpoint") as `draw_viewpoint`.
    """
    params, rng = spec.observation, generator(spec.seed, Stream.OBSERVE, *item)
    room, target_m = house.house.room(room_id), geometry.T_world_object[0, :3, 3]
    camera, share = draw_viewpoint(rays, room, house.obstacles, target_m, params, spec.candidates, rng)

    def draw_cloud() -> Cloud:
        cast: PixelCaster = partial(cast_pixels, rays, camera)  # only the pixels that the cloud samples
        if params.noise.enabled:  # it needs neighbouring pixels
            noise_rng = generator(spec.seed, Stream.NOISE, *item)
            cast = caster_of(render_frame(params, geometry, camera, noise_rng))
        return observe_cloud(cast, camera, 1, target_m, float(rays.radii_m[0]), params, rng)

    return camera, share, draw_cloud


def noise_of(scene: ReconstructedScene, room_id: str, spec: Specification) -> np.random.Generator:
    """The random numbers from which the depth noise of a stored scene's cloud was drawn."""
    item: tuple[int, ...] = (scene.index, scene.retry)
    if spec.scenes_from is not None and (view := spec.scenes_from.view) is not None:
        try:
            observe(scene.house, room_id, scene.geometry, scene.rays, spec, seen := (*item, view))
            item = seen
        except SceneRejected:  # no other place sees the target: the cloud is the first one
            pass
    return generator(spec.seed, Stream.NOISE, *item)


def _reach_of(spec: Specification) -> ReachableSet | None:
    """The reachable set by which candidates are in range. InputError where the specification has no robot."""
    if spec.candidates.in_range_by is None:
        return None
    if spec.arm is None:
        fix = "Submit plan or sim, which have an arm"
        raise InputError("specification", "candidates.in_range_by", "has no robot", fix)
    # Needs the compiler, which labels without an arm do not.
    from datagen.workers.motion.reachable_sampling import reachable_set_of

    return reachable_set_of(spec.arm.robot_key)


def _house_with(world: World, house_id: str, kind: PlaceKind) -> PreparedHouse:
    """The house. Raises SceneRejected if it is damaged or has no such place, and the job draws another."""
    try:
        if house_id not in world.lacking:
            house, scene = world.house(house_id).house, world.spec.scene
            world.lacking[house_id] = {
                each: describe_surfaces(house, scene, each)
                for each in PLACE_KINDS
                if not eligible_surfaces(house, scene, each)
            }
        if kind in world.lacking[house_id]:
            raise SceneRejected("no_surface", world.lacking[house_id][kind])
        return world.house(house_id)
    except InputError as error:
        where = f"{error.place}: {error.field}" if error.field else error.place
        raise SceneRejected("bad_house", f"{where}: {error.problem}") from error


def _draw_names(world: World, rng: np.random.Generator, clock: StageClock) -> list[str]:
    """The target first, then clutter, all different unless there are fewer objects than the scene needs."""
    with clock.stage("draw" if world.spec.arm is None else "grasps"):
        target = world.draw_target(rng)
    others = [name for name in world.object_names if name != target] or [target]
    scene = world.spec.scene
    size = scene.n_clutter if scene.places is None else int(rng.integers(scene.n_clutter + 1))
    clutter = rng.choice(len(others), size=size, replace=size > len(others))
    return [target, *(others[k] for k in clutter)]


def check_settled(
    settled: SettleResult, models: tuple[ObjectModel, ...], surface: Surface, params: SettleParams
) -> None:
    """Raise SceneRejected for an unusable result: not finite, moving, penetrating, or fallen off."""
    T = settled.T_world_object
    if not np.isfinite(T).all():
        raise SceneRejected("not_finite")
    if not settled.at_rest:
        raise SceneRejected("not_at_rest")
    local = (T[:, :3, 3] - surface.T_world_surface[:3, 3]) @ surface.T_world_surface[:3, :3]
    bottoms_m = np.array([_lowest_m(m, T[k]) for k, m in enumerate(models)]) - surface.height_m
    beyond = (np.abs(local[:, :2]) > np.array(surface.size_m) / 2).any()
    if beyond or (bottoms_m < -params.max_drop_m).any():
        raise SceneRejected("fell_off")
    if settled.penetration_m > params.max_penetration_m:
        raise SceneRejected("penetration")


def _lowest_m(model: ObjectModel, T_world_object: F64) -> float:
    z = T_world_object[2, :3]
    return float(min((part @ z).min() for part in model.convex_parts_m) + T_world_object[2, 3])


def render_frame(
    params: ObservationParams, geometry: SceneGeometry, camera: Camera, noise_rng: np.random.Generator
) -> Frame:
    """The whole frame by the specified renderer, with the specified noise."""
    frame = load_renderer(params.renderer)(geometry, camera)
    return add_noise(frame, params.noise, noise_rng) if params.noise.enabled else frame


_WINDOW_PX = 32  # rays per side to evaluate a viewpoint; coarser than for labels
_BLOCK = 4


def draw_viewpoint(
    rays: RayScene,
    room: Room,
    obstacles: HouseObstacles,
    target_center_m: F64,
    params: ObservationParams,
    robot: CandidateParams,
    rng: np.random.Generator,
) -> tuple[Camera, float]:
    """A camera at a free position in the room, and the share of the target that it sees.

    The carrier is a column of the robot's base radius up to the camera. Raises
    SceneRejected("no_viewpoint") if none of `max_viewpoints` positions is usable.
    """
    n = params.max_viewpoints
    angle = rng.uniform(-np.pi, np.pi, n)
    distance_m = rng.uniform(params.distance_m.low, params.distance_m.high, n)
    height_m = rng.uniform(params.camera_height_m.low, params.camera_height_m.high, n)
    xy = target_center_m[:2] + distance_m[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    column = height_m.astype(np.float32)
    radius_m = np.full(n, robot.base_radius_m)
    clearance_m = base_clearance_m(
        xy.astype(np.float32), column, column, radius_m, obstacles, robot.mast_radius_m
    )
    free = clearance_m >= 0
    usable = np.flatnonzero(free & inside_polygon(xy, room.polygon_m))
    eyes_m = np.column_stack([xy, height_m])
    for start in range(0, len(usable), _BLOCK):
        rows = usable[start : start + _BLOCK]
        alone, seen = visible_pixels(rays, 0, eyes_m[rows], _WINDOW_PX)
        share = seen / np.maximum(alone, 1)
        good = np.flatnonzero((share >= params.min_target_fraction) & (alone > 0))
        if len(good):
            row = rows[good[0]]
            return camera_at(eyes_m[row], target_center_m, params), float(share[good[0]])
    raise SceneRejected("no_viewpoint")


def camera_at(eye_m: F64, target_m: F64, params: ObservationParams) -> Camera:
    """The observation camera at `eye_m` (3,), turned to `target_m` (3,), principal point centred."""
    return Camera(
        T_world_camera=look_at(eye_m, target_m),
        width_px=params.width_px,
        height_px=params.height_px,
        fx_px=params.fx_px,
        fy_px=params.fy_px,
        cx_px=params.width_px / 2,
        cy_px=params.height_px / 2,
    )

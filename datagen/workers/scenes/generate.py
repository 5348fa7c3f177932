"""Sample one scene from its random streams: place, settle, sample bases, observe; retry on rejection."""

from __future__ import annotations

from collections import Counter

import numpy as np

from datagen.schemas.cost import StageClock
from datagen.schemas.errors import InputError
from datagen.schemas.identity import Stream, generator
from datagen.schemas.specification import ObservationParams, SettleParams
from datagen.workers.bases.candidates import SceneCandidates, draw_candidates
from datagen.workers.geometry.mesh import F64
from datagen.workers.houses.house import Surface
from datagen.workers.objects.model import ObjectModel
from datagen.workers.rendering import load_renderer
from datagen.workers.rendering.cloud import Cloud, PixelCaster, caster_of, observe_cloud
from datagen.workers.rendering.embree_renderer import cast_pixels
from datagen.workers.rendering.frame import Camera, Frame, SceneGeometry
from datagen.workers.rendering.noise import add_noise
from datagen.workers.rendering.rays import RayScene
from datagen.workers.scene_rejected import SceneRejected
from datagen.workers.scenes.placement import drop_poses, eligible_surfaces, nearby_parts, standing_footprints
from datagen.workers.scenes.scene import Scene
from datagen.workers.scenes.viewpoint import draw_viewpoint
from datagen.workers.settling import load_settler
from datagen.workers.settling.settler import SettleResult
from datagen.workers.world import PreparedHouse, World

# Objects that roll off the support touch no static part farther from it than this.
_SURROUNDINGS_M = 0.3


def generate_scene(world: World, index: int, clock: StageClock) -> tuple[Scene, SceneCandidates]:
    """Sample scene `index` of the specification and its candidates: the first accepted try.

    Raises InputError after `scene.max_retries` rejections.
    """
    redraws, detail = Counter[str](), ""
    for retry in range(world.spec.scene.max_retries):
        try:
            return _try_scene(world, index, retry, dict(redraws), clock)
        except SceneRejected as rejection:
            redraws[rejection.cause] += 1
            detail = rejection.detail or detail
    causes = ", ".join(f"{cause} {count}" for cause, count in redraws.most_common())
    raise InputError(
        f"scene {index}",
        "scene.max_retries",
        f"no usable scene in {world.spec.scene.max_retries} tries ({causes}) {detail}",
        "Check the most frequent cause: other houses or objects, or wider limits, may help",
    )


def _try_scene(
    world: World, index: int, retry: int, redraws: dict[str, int], clock: StageClock
) -> tuple[Scene, SceneCandidates]:
    spec = world.spec
    with clock.stage("draw"):
        rng = generator(spec.seed, Stream.SCENE, index, retry)
        house = _load_house(world, world.house_ids[rng.integers(len(world.house_ids))])
        surfaces = eligible_surfaces(house.house, spec.scene)
        if not surfaces:
            raise SceneRejected("no_surface")
        surface = surfaces[rng.integers(len(surfaces))]
        names = _draw_names(world, rng, clock)
        models = tuple(world.object(name) for name in names)
        taken = standing_footprints(house.house, surface)
        start = drop_poses(models, surface, taken, spec.scene, rng)
        static = nearby_parts(house.house, surface, _SURROUNDINGS_M)

    with clock.stage("settle"):
        settled = load_settler(spec.settle.engine)(static, models, start, spec.settle)
        check_settled(settled, models, surface, spec.settle)

    target_m = settled.T_world_object[0, :3, 3]
    with clock.stage("draw"):
        rng = generator(spec.seed, Stream.CANDIDATES, index, retry)
        candidates = draw_candidates(target_m, house.obstacles, spec.candidates, rng)
        if candidates is None:
            raise SceneRejected("no_base")

    with clock.stage("observe"):
        rays = world.ray_scene(house, names, settled.T_world_object)
        room = house.house.room(surface.room_id)
        rng = generator(spec.seed, Stream.OBSERVE, index, retry)
        camera, share = draw_viewpoint(
            rays, room, house.obstacles, target_m, spec.observation, spec.candidates, rng
        )
        geometry = SceneGeometry(house.house, models, settled.T_world_object)
        noise_rng = generator(spec.seed, Stream.NOISE, index, retry)
        cloud = _observe(spec.observation, geometry, rays, camera, rng, noise_rng)
    scene = Scene(index, retry, redraws, house, surface, models, settled, rays, camera, share, cloud)
    return scene, candidates


def _load_house(world: World, house_id: str) -> PreparedHouse:
    """The house. Raises SceneRejected if it is damaged, so that the job continues with another."""
    try:
        return world.house(house_id)
    except InputError as error:
        raise SceneRejected("bad_house", str(error)) from error


def _draw_names(world: World, rng: np.random.Generator, clock: StageClock) -> list[str]:
    """The target first, then clutter, all different."""
    with clock.stage("draw" if world.spec.arm is None else "grasps"):
        target = world.draw_target(rng)
    others = [name for name in world.object_names if name != target]
    clutter = rng.choice(len(others), size=world.spec.scene.n_clutter, replace=False)
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
    """Height of the object's lowest point, world."""
    z = T_world_object[2, :3]
    return float(min((part @ z).min() for part in model.convex_parts_m) + T_world_object[2, 3])


def render_frame(
    params: ObservationParams, geometry: SceneGeometry, camera: Camera, noise_rng: np.random.Generator
) -> Frame:
    """The whole frame by the specified renderer, with the specified noise."""
    frame = load_renderer(params.renderer)(geometry, camera)
    return add_noise(frame, params.noise, noise_rng) if params.noise.enabled else frame


def _observe(
    params: ObservationParams,
    geometry: SceneGeometry,
    rays: RayScene,
    camera: Camera,
    rng: np.random.Generator,
    noise_rng: np.random.Generator,
) -> Cloud:
    # Embree casts only the pixels that the cloud samples. Noise needs neighbouring pixels, and the
    # other renderers make whole frames.
    single = params.renderer == "embree" and not params.noise.enabled
    cast: PixelCaster = (
        (lambda pixels: cast_pixels(rays, camera, pixels))
        if single
        else caster_of(render_frame(params, geometry, camera, noise_rng))
    )
    radius_m = float(rays.radii_m[0])
    return observe_cloud(cast, camera, 1, geometry.T_world_object[0, :3, 3], radius_m, params, rng)

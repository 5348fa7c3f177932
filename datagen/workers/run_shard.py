"""Compute one shard, from scene indices to checked arrays. Read this first.

draw a house, a support, a target and clutter   (resampled until accepted)
settle them by physics
sample base candidates
observe one RGB-D frame                         (or reconstruct scene and candidates from a stored run)
label the candidates                            (and again with the next scene until one is decisive)
check the batch against its schema
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.fields import OUTCOMES, REDRAW_CAUSES, SceneRows, sized_schema
from datagen.schemas.identity import Stream, generator, sample_ids
from datagen.schemas.run_records import StageClock
from datagen.schemas.specification import DECISIVE_SHARES, PLACE_KINDS, Specification
from datagen.workers.bases.candidates import SceneCandidates
from datagen.workers.labels import LabelSource, load_label_source
from datagen.workers.rendering import Camera
from datagen.workers.rendering.cloud import Cloud
from datagen.workers.scenes import Scene
from datagen.workers.scenes.generate import generate_scene, observe
from datagen.workers.scenes.placement import SceneRejected, draw_place
from datagen.workers.scenes.reconstruct import ReconstructedScene, reconstruct_candidates, reconstruct_scene
from datagen.workers.watched_clock import WatchedClock
from datagen.workers.world import World

Columns = dict[str, np.ndarray[Any, Any]]

MOST_DECISIVE_DRAWS = 40


@dataclass(frozen=True, eq=False)
class ShardResult:
    """Arrays by field name, one row per scene and one per sample, with their cost."""

    scene: Columns
    sample: Columns
    clock: StageClock
    redraws: dict[str, int]


def run_shard(
    spec: Specification,
    world: World,
    scene_indices: Sequence[int],
    stored: Iterable[SceneRows] | None = None,
    watch: Callable[[str, int], None] | None = None,
) -> ShardResult:
    """Generate the scenes of these indices, or read them from `stored`, and label their candidates.

    The same specification and index give the same bytes, whatever else is in the shard. Stored
    scenes keep their bytes. `watch(stage, labels)` is called when a stage begins. Raises InputError
    if a stored scene does not match its index, or its house and objects are not those of the world.
    """
    source, spec_hash = load_label_source(spec.label_source), spec.hash()
    schema = sized_schema(source.schema, spec)
    clock, redraws = WatchedClock(), Counter[str]()
    clock.watch = watch or clock.watch
    scene_rows: list[Mapping[str, Any]] = []
    sample_blocks: list[Columns] = []
    rows_of = [None] * len(scene_indices) if stored is None else stored
    for index, rows in zip(scene_indices, rows_of, strict=True):
        if rows is None:
            scene, candidates, labelled, draws = _labelled_scene(world, index, source, clock)
            redraws.update(scene.redraws)
            drawn = {"decisive_draws": draws, "good_share": good_share(candidates, labelled)}
            with clock.stage("observe"):
                record = scene_row(scene, spec) | drawn
        else:
            scene = _stored_scene(world, index, rows, clock)
            candidates, record = reconstruct_candidates(rows.samples, scene), rows.record
            if spec.scenes_from is None or (view := spec.scenes_from.view) is None:
                labelled = source.label(scene, candidates, spec, clock)
            else:  # no label depends on that camera
                with clock.stage("observe"):
                    record = _seen_again(scene, spec, rows, view)
                own = candidate_columns(index, candidates, spec_hash, source)
                labelled = {name: column for name, column in rows.samples.items() if name not in own}
        scene_rows.append(record)
        sample_blocks.append(candidate_columns(index, candidates, spec_hash, source) | labelled)
        clock.labels = sum(len(block["label"]) for block in sample_blocks)

    scene_columns = {
        f.name: np.array([row[f.name] for row in scene_rows], object if f.dtype == "string" else f.dtype)
        for f in schema.scene_fields
    }
    sample_columns = {name: np.concatenate([b[name] for b in sample_blocks]) for name in sample_blocks[0]}
    schema.check("scene", len(scene_rows), scene_columns)
    schema.check("sample", sum(len(b["label"]) for b in sample_blocks), sample_columns)
    return ShardResult(scene_columns, sample_columns, clock, dict(redraws))


def _stored_scene(world: World, index: int, rows: SceneRows, clock: StageClock) -> ReconstructedScene:
    with clock.stage("draw"):
        scene = reconstruct_scene(world, rows.record)
    if scene.index != index:
        problem = f"scene {scene.index} is stored where scene {index} belongs"
        raise InputError("stored scenes", "scene_index", problem, "Make the run that stores them again")
    return scene


def _labelled_scene(
    world: World, index: int, source: LabelSource, clock: StageClock
) -> tuple[Scene, SceneCandidates, Columns, int]:
    """Scene `index` with its candidates and labels, and how many scenes were labelled until it was decisive.

    The last is 0 where the specification takes the first scene. Trials are not run to decide.
    """
    spec, scene, draws = world.spec, None, 0
    if not draw_place(spec.scene, generator(spec.seed, Stream.PLACE, index))[1]:
        scene, candidates = generate_scene(world, index, clock)
        return scene, candidates, source.label(scene, candidates, spec, clock), draws
    # Needs the compiler, which labels without an arm do not.
    from datagen.workers.labels.arm_sources import label_within

    assert spec.arm is not None
    plain = spec.arm.model_copy(update={"trial": None, "disturbance": None, "draws": None})
    plan_spec = spec.model_copy(update={"arm": plain})
    while True:
        draws, (scene, candidates) = draws + 1, generate_scene(world, index, clock, scene)
        shares = DECISIVE_SHARES if draws < MOST_DECISIVE_DRAWS else (0.0, 1.0)
        labelled = label_within(scene, candidates, plan_spec, clock, shares)
        if labelled is not None:
            break
    if source.name != "plan" or plan_spec != spec:
        labelled = source.label(scene, candidates, spec, clock)
    return scene, candidates, labelled, draws


def good_share(candidates: SceneCandidates, labelled: Columns) -> float:
    """Share of positive labels among the candidates that are clear and in reach; 0 where there are none."""
    among = candidates.clearance_m >= 0
    if "outcome" in labelled:
        among &= labelled["outcome"] != list(OUTCOMES).index("out_of_reach")
    return float(labelled["label"][among].mean()) if among.any() else 0.0


def scene_row(scene: Scene, spec: Specification) -> dict[str, Any]:
    """The scene's record, by field name, without what depends on its labels."""
    house, surface = scene.house.house, scene.surface
    # Rows have as many objects as the specification allows.
    free = 1 + spec.scene.n_clutter - len(scene.models)
    return {
        "scene_index": scene.index,
        "retry": scene.retry,
        "redraws": [scene.redraws.get(cause, 0) for cause in REDRAW_CAUSES],
        "house_id": house.house_id,
        "house_digest": house.digest,
        "room_id": surface.room_id,
        "room_type": house.room(surface.room_id).room_type,
        "support_id": surface.surface_id,
        "support_type": surface.object_type,
        "place": PLACE_KINDS.index(surface.kind),
        "T_world_support": surface.T_world_surface,
        "support_size_m": surface.size_m,
        "object_name": [m.name for m in scene.models] + [""] * free,
        "object_digest": [m.digest for m in scene.models] + [""] * free,
        "object_mass_kg": [m.mass_kg for m in scene.models] + [0.0] * free,
        "T_world_object": np.concatenate([scene.T_world_object, np.tile(np.eye(4), (free, 1, 1))]),
        "settle_steps": scene.settled.steps,
        "residual_speed_mps": scene.settled.residual_speed_mps,
        "penetration_m": scene.settled.penetration_m,
        "target_center_m": scene.target_center_m,
        "target_radius_m": scene.rays.radii_m[0],
        **_seen_row(scene.camera, scene.target_visible_fraction, scene.cloud),
    }


def _seen_row(camera: Camera, share: float, cloud: Cloud) -> dict[str, Any]:
    """The fields of a scene's record that depend on where it was observed from."""
    return {
        "T_world_camera": camera.T_world_camera,
        "intrinsics_px": (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px),
        "image_size_px": (camera.width_px, camera.height_px),
        "target_visible_fraction": share,
        "points_m": cloud.points_m,
        "rgb": cloud.rgb,
        "target_mask": cloud.target_mask,
        "n_points": cloud.n,
    }


def _seen_again(scene: ReconstructedScene, spec: Specification, rows: SceneRows, view: int) -> dict[str, Any]:
    """The stored record as seen from another viewpoint, or as it is where no other sees the target."""
    item = (scene.index, scene.retry, view)
    try:
        room_id = str(rows.record["room_id"])
        camera, share, draw_cloud = observe(scene.house, room_id, scene.geometry, scene.rays, spec, item)
    except SceneRejected:
        return dict(rows.record)
    return {**rows.record, **_seen_row(camera, share, draw_cloud())}


def candidate_columns(
    scene_index: int, candidates: SceneCandidates, spec_hash: str, source: LabelSource
) -> Columns:
    """The columns that depend on the candidates alone, one row per candidate."""
    n, index = len(candidates), candidates.index
    return {
        "sample_id": sample_ids(spec_hash, scene_index, index),
        "sample_scene_index": np.full(n, scene_index, np.int64),
        "candidate_index": index,
        "robot_index": candidates.robot_index,
        "base_xy_m": candidates.base_xy_m,
        "base_yaw_rad": candidates.base_yaw_rad,
        "camera_height_m": candidates.camera_height_m,
        "base_height_m": candidates.base_height_m,
        "arm_reach_m": candidates.arm_reach_m,
        "base_clearance_m": candidates.clearance_m,
        "base_is_clear": candidates.clearance_m >= 0,
        "label_source": np.full(n, source.name, dtype=object),
        "label_version": np.full(n, source.version, np.int16),
    }

"""Make a specification, a layout and a manifest from options and a TOML file."""

from __future__ import annotations

import platform
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from datagen import __version__
from datagen.cluster.protocol import code_digest
from datagen.configuration.robot_fields import (
    Fields,
    complete_arm,
    narrow_candidates,
    refuse_unsuited,
    robot_of,
)
from datagen.configuration.toml_files import first_of, read_toml
from datagen.schemas.errors import InputError, choices
from datagen.schemas.fields import SCHEMAS
from datagen.schemas.record_files import utc_now
from datagen.schemas.run_records import Layout, Manifest
from datagen.schemas.specification import (
    CandidateParams,
    PlaceKind,
    SceneParams,
    Source,
    Specification,
)
from datagen.workers.engine_versions import ARM_PACKAGES, arm_versions, label_engines, scene_engines
from datagen.workers.extras import versions_of
from datagen.workers.geometry.planar import crosses_itself
from datagen.workers.houses.house import HouseSource
from datagen.workers.labels import load_label_source
from datagen.workers.objects.model import ObjectSource
from datagen.workers.rendering import RENDERERS, load_renderer
from datagen.workers.robots import robot_limits
from datagen.workers.scenes.placement import eligible_surfaces
from datagen.workers.settling import SETTLERS, first_settler, load_settler

Options = Mapping[str, Any]  # by dotted name in the specification; None where not given

_LIBRARIES = ("numpy", "scipy", "embreex", "sapien", "pybullet", "zarr", "obstore", "ray", "trimesh")
# A shard has at most a minute of work, which a lost attempt repeats, and at most tens of megabytes; enough
# work that 40 ms of writing are little; and no larger a part of the run than lets workers share it evenly.
_LONGEST_S, _SHORTEST_S = 60.0, 2.0
_MOST_BYTES = 32 * 2**20
_SHARDS, _SHARDS_AT_LEAST = 64, 8
# Core seconds of a label, scene included, and bytes of a cloud's point (docs/results/speed.md).
_LABEL_S = {"heuristic": 0.002, "plan": 0.03, "sim": 0.1}
_DECISIVE_COST = 4  # times that, where scenes are drawn until they are decisive
_POINT_BYTES = 10
# By default, for labels within reach: places of targets by weight, most clutter, share of decisive scenes.
_PLACES: dict[PlaceKind, float] = {"top": 2, "shelf": 2, "inside": 3, "seat": 1, "floor": 1, "sink": 1}
_CLUTTER, _DECISIVE = 14, 0.5
_HOUSES_SEEN, _SHARE_WITH_PLACE = 20, 0.1  # to find the kinds of places that a source has
_ABOVE_LOWEST_M = 0.1  # from the lowest point within reach to the lowest place


def specify(
    label_source: str,
    houses: HouseSource,
    objects: ObjectSource,
    options: Options,
    config: Path | None,
    robot: str | None = None,
    repeats: int | None = None,
    draws: int | None = None,
) -> Specification:
    """Return the specification of the options (dotted names, None where not given) and the file.

    An option overrides the file, and the file the default. `robot`, `repeats` and `draws` are --robot,
    --perturb and --draws.
    Raises InputError for an option, for a field of the file, and for an engine that cannot be imported here.
    """
    place = str(config) if config else "options"
    fields = read_fields(config)
    for name, value in options.items():
        if value is not None:
            put_field(fields, name, value, config)
    settle = fields.setdefault("settle", {})
    if isinstance(settle, dict):
        # SAPIEN where it can be imported, else the first that can; the choice is recorded.
        settle.setdefault("engine", first_settler())
    complete_arm(label_source, fields, robot, repeats, place, draws)
    chosen = robot_of(fields, robot)
    if chosen is not None:
        narrow_candidates(fields, chosen)
    candidates = fields.setdefault("candidates", {})
    if isinstance(candidates, dict):
        # A robot with a mobile base of its own has the same one at every reach.
        if chosen is None or robot_limits(chosen).base_radius_m is None:
            candidates.setdefault("scaled_base", True)
        if label_source in ARM_PACKAGES and "within" not in candidates:
            candidates.setdefault("per_scene", "grid")
        is_near = label_source in ARM_PACKAGES and candidates.get("within") == "in-range"
        asked = complete_scene(fields, candidates, houses if is_near else None)
        if is_near and _needs_set(chosen, asked.get("places") is not None):
            candidates.setdefault("in_range_by", "reachable-set")
        if candidates.get("per_scene") == "grid" or asked.get("decisive") is not None:
            # The cells of a whole grid are ranked against each other, so they have one robot.
            candidates.setdefault("robots_per_scene", 1)
    fields |= {
        "label_source": label_source,
        "houses": Source(kind=houses.kind, digest=houses.digest),
        "objects": Source(kind=objects.kind, digest=objects.digest),
    }
    spec = validated(fields, place)
    if spec.candidates.per_scene == "grid" and spec.candidates.within is not None:
        problem = f"a whole grid has cells that are not {spec.candidates.within}"
        raise InputError(place, "candidates.within", problem, "Give --candidates-per-scene 60")
    if spec.candidates.in_range_by is not None:
        _prepare_set(spec, place)
    if spec.scene.decisive is not None and spec.arm is None:
        problem = f"{label_source} has no arm, and a scene is decisive for one"
        raise InputError(place, "scene.decisive", problem, "Omit it, or submit plan or sim")
    if spec.scene.decisive is not None and spec.candidates.robots_per_scene > 1:
        problem = f"{spec.candidates.robots_per_scene} robots, and a scene is decisive for one"
        raise InputError(place, "candidates.robots_per_scene", problem, "Set it to 1")
    footprint_m = spec.candidates.footprint_m
    if footprint_m is not None and crosses_itself(np.array(footprint_m)):
        raise InputError(place, "candidates.footprint_m", "crosses itself", "Give its corners in order")
    if chosen is not None:
        refuse_unsuited(spec, chosen, place, "Correct the values, or choose another --robot")
    for field, name, registry in (
        ("settle.engine", spec.settle.engine, SETTLERS),
        ("observation.renderer", spec.observation.renderer, RENDERERS),
    ):
        if name not in registry:
            raise InputError(place, field, f"{name!r} is unknown", choices(registry, name))
    load_settler(spec.settle.engine)
    load_renderer(spec.observation.renderer)
    return spec.model_copy(update={"engines": scene_engines(spec) | label_engines(spec.label_source)})


def complete_scene(fields: Fields, candidates: Fields, houses: HouseSource | None) -> Fields:
    """Fill in the section `scene` of a specification's fields, and return it.

    In place of open tops alone it has the mix of places where parking decides, of those that `houses` have;
    None keeps open tops. In the file `places = {}` and `decisive = 0` say that there are none.
    """
    scene = fields.setdefault("scene", {})
    if not isinstance(scene, dict):
        return {}  # the specification refuses it
    is_default = houses is not None and "places" not in scene
    for name, nothing in (("places", {}), ("decisive", 0)):
        if scene.get(name) == nothing:
            scene[name] = None
    if houses is None or not is_default:
        return scene
    try:
        params = SceneParams.model_validate(scene), CandidateParams.model_validate(candidates)
    except ValidationError:
        return scene
    kinds = _kinds_in(houses, *params)
    if kinds not in ([], ["top"]):
        scene |= {"places": {kind: _PLACES[kind] for kind in kinds}}
        scene.setdefault("n_clutter", _CLUTTER)
        if candidates.get("robots_per_scene", 1) == 1:
            scene.setdefault("decisive", _DECISIVE)
    return scene


def _kinds_in(houses: HouseSource, scene: SceneParams, candidates: CandidateParams) -> list[PlaceKind]:
    """The kinds of places that are not rare in houses, nor all too low for the arm."""
    lowest_m = candidates.base_height_m.low - candidates.arm_reach_m.high + _ABOVE_LOWEST_M
    found, ids = Counter[PlaceKind](), houses.house_ids()
    seen = ids[:: max(1, len(ids) // _HOUSES_SEEN)][:_HOUSES_SEEN]
    for house_id in seen:
        try:
            house = houses.load(house_id)
            if house.open_doors is None:
                return ["top"]  # the source knows no others
            house = house.open_doors()
        except InputError:
            continue  # reported where houses are examined
        for kind in _PLACES:
            found[kind] += any(s.height_m >= lowest_m for s in eligible_surfaces(house, scene, kind))
    return [kind for kind in _PLACES if found[kind] > _SHARE_WITH_PLACE * len(seen)]


def _needs_set(robot: str | None, has_places: bool) -> bool:
    """Whether candidates in range come from a reachable set: also where targets are as low as the floor."""
    # Opens the robot, for which labels without an arm lack libraries.
    from datagen.workers.motion.reachable_sampling import needs_set

    if robot is None:
        return False
    low, high = robot_limits(robot).reach_m
    return needs_set(robot) or (has_places and low == high)


def _prepare_set(spec: Specification, place: str) -> None:
    """Compute the robot's reachable set, which workers then find in the cache. InputError without a robot."""
    if spec.arm is None:
        problem, fix = f"{spec.label_source} has no arm", "Remove it, or submit plan or sim"
        raise InputError(place, "candidates.in_range_by", problem, fix)
    from datagen.workers.motion.reachable_sampling import reachable_set_of

    reachable_set_of(spec.arm.robot_key)


def read_fields(config: Path | None) -> dict[str, Any]:
    """The fields of the file. Raises InputError for those that only the command line may set."""
    fields = read_toml(config) if config else {}
    for reserved in ("label_source", "houses", "objects", "engines", "scenes_from"):
        if reserved in fields:
            raise InputError(
                config or "", reserved, "cannot be set in this file", "Give it on the command line instead"
            )
    return fields


def validated(fields: dict[str, Any], place: str) -> Specification:
    """The specification of these fields. Raises InputError for the first that is wrong."""
    try:
        return Specification.model_validate(fields)
    except ValidationError as error:
        raise first_of(error, place) from None


def layout_of(spec: Specification, n: int) -> Layout:
    """The layout: shards by time and bytes, and smaller ones in a small run.

    A number of scenes that divides evenly is preferred, so that no label beyond n is made.
    """
    scenes = -(-n // spec.candidates.count)
    scene_s = spec.candidates.count * _LABEL_S.get(spec.label_source, _LABEL_S["plan"])
    scene_s *= _DECISIVE_COST if spec.scene.decisive else 1
    largest = min(_LONGEST_S / scene_s, _MOST_BYTES / (_POINT_BYTES * spec.observation.n_points))
    shared = max(scenes // _SHARDS, min(scenes // _SHARDS_AT_LEAST, int(_SHORTEST_S / scene_s)))
    most = max(1, min(int(largest), shared))
    even = next((k for k in range(most, most // 2, -1) if scenes % k == 0), most)
    return Layout(scenes_per_shard=even, candidates_per_scene=spec.candidates.count)


def manifest_of(spec: Specification, layout: Layout, sources: dict[str, str]) -> Manifest:
    """The manifest of a new run."""
    source = load_label_source(spec.label_source)
    return Manifest(
        spec=spec,
        spec_hash=spec.hash(),
        schema_name=source.schema,
        schema_version=SCHEMAS[source.schema].version,
        layout=layout,
        code_version=__version__,
        code_digest=code_digest(),
        libraries={name: found for name, found in versions_of(_LIBRARIES).items() if found}
        | arm_versions(spec.label_source),
        platform=platform.platform(),
        created=utc_now(),
        sources=sources,
    )


def put_field(fields: dict[str, Any], name: str, value: Any, config: Path | None) -> None:
    """Set a dotted name in nested dictionaries."""
    *parents, leaf = name.split(".")
    for parent in parents:
        below = fields.setdefault(parent, {})
        if not isinstance(below, dict):
            raise InputError(config or "", parent, "is a value, not a section", f"Write [{parent}]")
        fields = below
    fields[leaf] = value

"""Scenes of habitat: a stage, and instances of objects with meshes (ReplicaCAD, HSSD, AI2-THOR).

ROOT/NAME.scene_dataset_config.json   names the folders of scenes
**/NAME.scene_instance.json           stage and object instances
**/NAME.object_config.json            {render_asset, collision_asset, scale, COM, semantic_id}
**/NAME.stage_config.json             {render_asset, scale}
**/NAME.glb                           meshes; also of templates without a configuration
**/NAME_semantic_lexicon.json         {classes: [{id, name}]}

Frame of the files: right-handed, y up; world (x, y, z) = (x, -z, y). Rotations are quaternions (w, x, y, z).
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path, PurePosixPath

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.identity import digest_of
from datagen.schemas.safe_files import read_regular
from datagen.workers.furniture.asset_geometry import type_of_name
from datagen.workers.furniture.assets import CARRYING_TYPES
from datagen.workers.geometry.mesh import F32, F64, Mesh, MeshFile, transformed_parts
from datagen.workers.geometry.transforms import rotation_of
from datagen.workers.houses.glb import read_glb
from datagen.workers.houses.habitat_checks import (
    is_about_centre,
    refuse_unfit_size,
    refuse_unfit_stage,
    refuse_upside_down,
)
from datagen.workers.houses.habitat_files import (
    FIX,
    AssetFiles,
    FindAsset,
    config_of,
    configured_files,
    file_digest,
    scene_folders,
    semantic_classes,
    sizes,
    template_name,
)
from datagen.workers.houses.house import House, Room, StaticBody, Surface
from datagen.workers.houses.loader import room_ids_at
from datagen.workers.houses.mesh_geometry import (
    convex_parts,
    flat_tops,
    normals_and_areas,
    outlines,
    slab_parts,
)
from datagen.workers.houses.walls_and_floors import MAX_CORNERS, clean_polygon
from datagen.workers.json_document import EXTENT_M, JsonNode, parse_json
from datagen.workers.source_statement import read_statement

SCENE = ".scene_instance.json"
_DATASET, _OBJECT, _STAGE = ".scene_dataset_config.json", ".object_config.json", ".stage_config.json"
_LEXICON = "_semantic_lexicon.json"
_MAX_SCENE_BYTES = 16 << 20
_MAX_OBJECTS = 5000
_KEPT_MESHES = 512
_SURFACE_HEIGHTS_M = (0.25, 1.5)
_WALL_TOP_M = 2.2  # no robot reaches parts above it
_SMALL_M = 0.35

# From every file's frame to the world.
_Y_UP_TO_WORLD = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])

# Number, template, its files, entry, `T_world_object`.
_Instance = tuple[int, str, "AssetFiles", JsonNode, F64]

# The first of these object types found in a room decides the room's type.
_ROOM_BY_TYPE = (
    ("Toilet", "Bathroom"), ("ShowerDoor", "Bathroom"), ("Bed", "Bedroom"), ("Fridge", "Kitchen"),
    ("CounterTop", "Kitchen"), ("Sofa", "LivingRoom"), ("Television", "LivingRoom"),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Template:
    """A mesh of the download in a z-up frame, with its convex parts and digest."""

    mesh: Mesh
    parts_m: tuple[F32, ...]
    digest: bytes


def known_type(name: str) -> str:
    """The type that a name ends in, or else the longest type of furniture with a top that it contains."""
    found = type_of_name(name)
    return carrying_type(name) if found == "Object" else found


def carrying_type(name: str) -> str:
    """The longest type of furniture with a top that a name contains; "Object" if there is none."""
    letters = "".join(c for c in name if c.isalpha()).lower()
    known_types = sorted(CARRYING_TYPES, key=lambda t: -len(t))
    return next((t for t in known_types if t.lower() in letters), "Object")


@dataclass(frozen=True, eq=False)
class HabitatHouses:
    """Scenes below one root. Recently used meshes are kept, because houses share furniture."""

    root: Path
    digest: str
    scenes: dict[str, Path]
    types: dict[int, str]
    find: FindAsset
    stage_turn: Callable[[str], F64] | None = None  # by house, from the stage's frame to the scene's, y up
    type_of: Callable[[str], str] = known_type  # of an object without a semantic id
    carrying: frozenset[str] = CARRYING_TYPES | {"Object"}  # types whose flat tops support objects
    statement: Mapping[str, str] = field(default_factory=dict)
    kind: str = "habitat"

    def house_ids(self) -> list[str]:
        """Ids, sorted: the scene's path below the root, or the folder of scenes, without its ending."""
        return list(self.scenes)

    @property
    def changed_ns(self) -> int:
        """When a scene was last changed: the digest covers their sizes, not their content."""
        return max(path.stat().st_mtime_ns for path in self.scenes.values())

    def load(self, house_id: str) -> House:
        """The house. Raises InputError that names the file and the field."""
        scene, text = self._scene(house_id)
        digest = hashlib.sha256(text)
        entry = scene.get("stage_instance")
        stage = self._template(self._stage_files(entry), True)
        digest.update(stage.digest)
        T_world = (
            _pose(entry, is_stage=True) if self.stage_turn is None else _in_world(self.stage_turn(house_id))
        )
        mesh = _without_ceiling(stage.mesh.transformed(T_world))
        refuse_unfit_stage(entry, mesh)
        placed: list[tuple[StaticBody, F64, F64, Mesh]] = []
        instances, findings = self._instances(scene)
        for number, name, files, entry, T_world in instances:
            template = self._template(files, False)
            digest.update(template.digest)
            if is_about_centre(entry, scene):
                centre_m = _centre_m(files, template)
                T_world[:3, 3] -= T_world[:3, :3] @ centre_m
                digest.update(centre_m.tobytes())
            placed.append(self._placed(number, name, files, template, T_world))
            refuse_unfit_size(entry, placed[-1][0].visual)
            digest.update(placed[-1][0].object_type.encode())  # the type decides on support surfaces
        bodies, rooms = _walls_and_rooms(mesh, [(b, xy) for b, xy, _, _ in placed])
        owners = room_ids_at(np.array([xy for _, xy, _, _ in placed]).reshape(-1, 2), rooms)
        surfaces: list[Surface] = []
        for (body, _, T, local), owner in zip(placed, owners, strict=True):
            bodies.append(replace(body, room_id=owner))
            carries = body.object_type in self.carrying
            if owner and carries and (body.kind == "furniture" or body.object_type in CARRYING_TYPES):
                # Runs in ai2thor houses keep their scenes: its stretched furniture carries nothing.
                surfaces.extend(_surfaces(body, owner, T, local, self.kind != "ai2thor"))
        return House(house_id, digest.hexdigest(), tuple(rooms), tuple(bodies), tuple(surfaces), findings)

    def examine(self, house_id: str) -> Mapping[str, int]:
        """The findings of the house; its meshes are not read. Raises InputError as `load` does for others."""
        scene, _ = self._scene(house_id)
        self._stage_files(scene.get("stage_instance"))
        return self._instances(scene)[1]

    def _stage_files(self, entry: JsonNode) -> AssetFiles:
        files = self.find(template_name(entry), True)
        if files is None or not files.mesh.is_file():
            raise entry.get("template_name").error(f"has no stage {template_name(entry)!r}", FIX)
        return files

    def _scene(self, house_id: str) -> tuple[JsonNode, bytes]:
        if house_id not in self.scenes:
            raise InputError(self.root, "", f"has no house {house_id!r}", "Give the id of one of its houses.")
        text = read_regular(self.scenes[house_id], _MAX_SCENE_BYTES, FIX)
        return parse_json(text, str(self.scenes[house_id])), text

    def _instances(self, scene: JsonNode) -> tuple[list[_Instance], Counter[str]]:
        """The objects whose meshes exist, and the findings."""
        found: list[_Instance] = []
        findings = Counter[str]()
        for number, entry in enumerate(scene.get("object_instances").items(_MAX_OBJECTS)):
            name = template_name(entry)
            if (files := self.find(name, False)) is not None and files.mesh.is_file():
                found.append((number, name, files, entry, _pose(entry)))
            else:
                findings["missing meshes"] += 1
        jointed = scene.find("articulated_object_instances")
        if jointed is not None and (count := len(list(jointed.items(_MAX_OBJECTS)))):
            findings["articulated objects"] = count
        refuse_upside_down(scene, [T for *_, T in found], findings)
        return found, findings

    @cached_property
    def _template(self) -> Callable[[AssetFiles, bool], _Template]:
        return lru_cache(_KEPT_MESHES)(_read_template)

    def _placed(
        self, number: int, name: str, files: AssetFiles, template: _Template, T: F64
    ) -> tuple[StaticBody, F64, F64, Mesh]:
        """The body, the point that decides its room, its pose and its mesh in its own frame."""
        mesh = template.mesh.transformed(T)
        parts = transformed_parts(template.parts_m, T)
        size_m = np.ptp(mesh.vertices_m, axis=0)
        object_type = self._type_of(name, files)
        is_small = bool(size_m.max() < _SMALL_M or (mesh.vertices_m[:, 2].min() > 0.2 and size_m.max() < 0.6))
        asset_id = PurePosixPath(name).name
        kind = "small" if is_small else "furniture"
        body = StaticBody(f"{number}|{asset_id}", kind, object_type, asset_id, "", mesh, parts)
        middle = (mesh.vertices_m.min(0) + mesh.vertices_m.max(0))[:2] / 2
        return body, middle.astype(np.float64), T, template.mesh

    def _type_of(self, name: str, files: AssetFiles) -> str:
        """The object type by the semantic id of the template's configuration, else by its name."""
        config = config_of(files)
        found = None if config is None else config.find("semantic_id")
        if found is not None:
            known = self.types.get(int(found.number(-1, 1e9)))
            if known is not None:
                return known
        return self.type_of(PurePosixPath(name).name)


def open_habitat(place: str) -> HabitatHouses:
    """The scenes of a folder's dataset: that with the shortest name, if the folder has several.

    Their configuration may be named in place of the folder. The digest of the source covers the names and
    sizes of all scenes, meshes and configurations, as that of `open_ai2thor`.
    """
    base = Path(place).expanduser()
    root = base if base.is_dir() else base.parent
    fix = f"Name it as habitat:DIR, where DIR holds *{_DATASET}, as ReplicaCAD and HSSD do"
    named = sorted(root.glob(f"*{_DATASET}"), key=lambda p: (len(p.name), p.name))
    if not place or not base.exists() or not named:
        raise InputError(place or "habitat", "", f"has no *{_DATASET}", fix)
    dataset = named[0] if base.is_dir() else base
    scenes = dict[str, Path]()
    listing: list[object] = []
    for folder in scene_folders(dataset):
        for path, size in sizes(root / folder, f"*{SCENE}"):
            scenes[path.relative_to(root).as_posix().removesuffix(SCENE)] = path
            listing.append([path.relative_to(root).as_posix(), size])
    if not scenes:
        raise InputError(dataset, "scene_instances", "names no folder with scenes", FIX)
    found = {end: sizes(root, f"*{end}") for end in (".glb", _OBJECT, _STAGE, _LEXICON)}
    listing += [[p.relative_to(root).as_posix(), n] for files in found.values() for p, n in files]
    types = {i: name for path, _ in found[_LEXICON] for i, name in semantic_classes(path)}
    digest = digest_of(["habitat-1", sorted(map(str, listing)), sorted(types.items())])
    index = {end: {p.name.removesuffix(end): p for p, _ in files[::-1]} for end, files in found.items()}

    def find(name: str, is_stage: bool) -> AssetFiles | None:
        own = PurePosixPath(name).name
        config = index[_STAGE if is_stage else _OBJECT].get(own)
        if config is not None:
            return configured_files(config, root)
        return None if own not in index[".glb"] else AssetFiles(index[".glb"][own])

    scenes = dict(sorted(scenes.items()))
    return HabitatHouses(root, digest, scenes, types, find, statement=read_statement(root))


def _read_template(files: AssetFiles, is_stage: bool) -> _Template:
    S = np.diag([*files.scale, 1.0])
    mesh, digest = read_glb(files.mesh).transformed(_Y_UP_TO_WORLD @ S), file_digest(files.mesh)
    solid = mesh
    if files.collision is not None:
        solid = read_glb(files.collision).transformed(_Y_UP_TO_WORLD @ S)
        digest = hashlib.sha256(digest + file_digest(files.collision)).digest()
    if files.scale != (1.0, 1.0, 1.0):
        digest = hashlib.sha256(digest + S.tobytes()).digest()
    return _Template(mesh, () if is_stage else convex_parts(solid), digest)


def _centre_m(files: AssetFiles, template: _Template) -> F64:
    """The point (3,) of a template, z up, that a scene may place: its configured centre of mass, or the
    centre of its bounding box."""
    config = config_of(files)
    centre = None if config is None else config.find("COM")
    if centre is not None:
        return _Y_UP_TO_WORLD[:3, :3] @ centre.numbers(3, -EXTENT_M, EXTENT_M)
    return (template.mesh.vertices_m.min(0) + template.mesh.vertices_m.max(0)).astype(np.float64) / 2


def _pose(entry: JsonNode, *, is_stage: bool = False) -> F64:
    """`T_world_object` of an instance; a stage that states no translation is at the origin."""
    at = entry.given("translation", [0, 0, 0]) if is_stage else entry.get("translation")
    position_m = at.numbers(3, -EXTENT_M, EXTENT_M)
    q = np.array(entry.given("rotation", [1, 0, 0, 0]).numbers(4, -2.0, 2.0))
    if not 0.5 < np.linalg.norm(q) < 2.0:
        raise entry.get("rotation").error("is not a unit quaternion")
    scale = entry.given("uniform_scale", 1).number(1e-3, 1e3)
    factors = scale * np.array(entry.given("non_uniform_scale", [1, 1, 1]).numbers(3, 1e-3, 1e3))
    T = np.eye(4)
    T[:3, :3] = rotation_of(q) * factors
    T[:3, 3] = position_m
    return _in_world(T)


def _in_world(T: F64) -> F64:
    """A pose (4, 4) of the files in the world frame, for meshes that are already z up."""
    return _Y_UP_TO_WORLD @ T @ np.linalg.inv(_Y_UP_TO_WORLD)


def _walls_and_rooms(
    stage: Mesh, things: list[tuple[StaticBody, F64]]
) -> tuple[list[StaticBody], list[Room]]:
    """The stage as a body, and a room for every patch of floor."""
    normals, _ = normals_and_areas(stage)
    corner_z = stage.vertices_m[stage.faces][:, :, 2]
    is_floor = (normals[:, 2] > 0.97) & (np.abs(corner_z).max(1) < 0.05)
    polygons: list[F64] = []
    for outline in outlines(stage, is_floor):
        polygon = clean_polygon(outline)
        if not isinstance(polygon, str) and len(polygon) <= MAX_CORNERS:
            polygons.append(polygon)
    if not polygons:  # the stage has no floor: use the ground below the walls
        low, high = stage.vertices_m.min(0)[:2], stage.vertices_m.max(0)[:2]
        polygons = [np.array([low, (high[0], low[1]), high, (low[0], high[1])], np.float64)]
    plain = [Room(f"room|{k}", "Room", p) for k, p in enumerate(polygons)]
    owners = room_ids_at(np.array([xy for _, xy in things]).reshape(-1, 2), plain)
    within: dict[str, set[str]] = {r.room_id: set() for r in plain}
    for (body, _), owner in zip(things, owners, strict=True):
        if owner:
            within[owner].add(body.object_type)
    rooms: list[Room] = []
    for room in plain:
        kind = next((name for t, name in _ROOM_BY_TYPE if t in within[room.room_id]), "Room")
        rooms.append(replace(room, room_type=kind))
    parts = slab_parts(stage, 0.02, _WALL_TOP_M)
    return [StaticBody("stage", "wall", "Wall", "", "", stage, parts)], rooms


def _without_ceiling(stage: Mesh) -> Mesh:
    """The stage, z up, without level faces near its top: houses are lit and seen from above."""
    normals, _ = normals_and_areas(stage)
    corner_z = stage.vertices_m[stage.faces][:, :, 2]
    near_top = corner_z.min(1) > max(1.8, float(stage.vertices_m[:, 2].max()) - 0.5)
    kept = ~((np.abs(normals[:, 2]) > 0.9) & near_top)
    file = None if stage.file is None else MeshFile(stage.file.path, stage.file.faces[kept])
    return Mesh(stage.vertices_m, stage.faces[kept], stage.face_rgb[kept], file=file)


def _surfaces(body: StaticBody, room_id: str, T: F64, local: Mesh, with_stretched: bool) -> list[Surface]:
    """Flat tops of an upright body; `T` may stretch its mesh along its own axes."""
    factors = np.linalg.norm(T[:3, :3], axis=0)
    if with_stretched and np.abs(factors - 1.0).max() > 1e-3:
        T, local = T @ np.diag([*1 / factors, 1.0]), local.transformed(np.diag([*factors, 1.0]))
    if T[2, 2] < 0.999 or abs(np.linalg.det(T[:3, :3]) - 1.0) > 1e-3:
        return []
    out: list[Surface] = []
    base_m = float(T[2, 3])
    low, high = (h - base_m for h in _SURFACE_HEIGHTS_M)
    for k, (height, rectangle) in enumerate(flat_tops(local, low, high)):
        T_surface = T.copy()
        T_surface[:3, 3] = T[:3, :3] @ (*rectangle.centre_m, height) + T[:3, 3]
        body_id, size_m = body.body_id, rectangle.size_m
        out.append(Surface(f"{body_id}/{k}", body_id, body.object_type, room_id, T_surface, size_m))
    return out

"""AI2-THOR scenes as the habitat conversion lays them out on disk.

ROOT/ai2thor-hab/configs/scenes/SET/**/NAME.scene_instance.json   stage and object instances
ROOT/ai2thor-hab/assets/stages/**/NAME.glb                        walls and floors
ROOT/ai2thorhab-uncompressed/assets/objects/NAME.glb              furniture and things
ROOT/ai2thorhab-uncompressed/configs/objects/NAME.object_config.json   {semantic_id}
ROOT/ai2thor-hab/configs/object_semantic_id_mapping.json          {object type: semantic id}

Frame of the files: right-handed, y up; world (x, y, z) = (x, -z, y). Rotations are quaternions
(w, x, y, z). Stages of the ProcTHOR set are stored turned by 90 degrees about the vertical.
"""

from __future__ import annotations

import hashlib
import itertools
from collections import Counter, OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, cast

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.identity import digest_of
from datagen.schemas.safe_files import open_regular, read_regular
from datagen.workers.furniture.assets import CARRYING_TYPES
from datagen.workers.geometry.mesh import F32, F64, Mesh
from datagen.workers.geometry.transforms import rotation_of
from datagen.workers.houses.glb import MAX_FILE_BYTES, read_glb
from datagen.workers.houses.habitat_checks import (
    is_about_centre,
    refuse_unfit_size,
    refuse_unfit_stage,
    refuse_upside_down,
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

_SUFFIX = ".scene_instance.json"
_SCENES = Path("ai2thor-hab/configs/scenes")
_OBJECTS = Path("ai2thorhab-uncompressed/assets")
_CONFIGS = Path("ai2thorhab-uncompressed/configs")
_STAGES = Path("ai2thor-hab/assets")
_MAX_FILES = 200_000  # files of one kind
_MAX_SCENE_BYTES = 16 << 20
_MAX_OBJECTS = 5000
_KEPT_MESHES = 512
_SURFACE_HEIGHTS_M = (0.25, 1.5)
_WALL_TOP_M = 2.2  # no robot reaches parts above it
_SMALL_M = 0.35
_FIX = "Download the scenes again."

# From every file's frame to the world, and the rotation of ProcTHOR stages back about the vertical.
_Y_UP_TO_WORLD = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
_PROCTHOR_STAGE = np.array([[0, 0, -1.0, 0], [0, 1.0, 0, 0], [1.0, 0, 0, 0], [0, 0, 0, 1.0]])

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


@dataclass(frozen=True, eq=False)
class Ai2thorHouses:
    """Scenes below one root. Recently used meshes are kept, because houses share furniture."""

    root: Path
    digest: str
    scenes: dict[str, Path]
    types: dict[int, str]
    statement: Mapping[str, str] = field(default_factory=dict)
    kind: str = "ai2thor"
    _templates: OrderedDict[Path, _Template] = field(default_factory=OrderedDict)

    def house_ids(self) -> list[str]:
        """Ids, sorted: the scene's path below configs/scenes without its ending."""
        return list(self.scenes)

    def load(self, house_id: str) -> House:
        """The house. Raises InputError that names the file and the field."""
        scene, text = self._scene(house_id)
        digest = hashlib.sha256(text)
        stage = self._template(self.root / _STAGES / f"{_template_name(scene.get('stage_instance'))}.glb")
        digest.update(stage.digest)
        turn = _PROCTHOR_STAGE if house_id.startswith("ProcTHOR/") else np.eye(4)
        mesh = _without_ceiling(stage.mesh.transformed(_in_world(turn)))
        refuse_unfit_stage(scene.get("stage_instance"), mesh)
        placed: list[tuple[StaticBody, F64, F64, Mesh]] = []
        instances, findings = self._instances(scene)
        for number, name, entry, T_world in instances:
            template = self._template(self.root / _OBJECTS / f"{name}.glb")
            digest.update(template.digest)
            if is_about_centre(entry, scene):
                centre_m = self._centre_m(name, template)
                T_world[:3, 3] -= T_world[:3, :3] @ centre_m
                digest.update(centre_m.tobytes())
            placed.append(self._placed(number, name, template, T_world))
            refuse_unfit_size(entry, placed[-1][0].visual)
            digest.update(placed[-1][0].object_type.encode())  # the type decides on support surfaces
        bodies, rooms = _walls_and_rooms(mesh, [(b, xy) for b, xy, _, _ in placed])
        owners = room_ids_at(np.array([xy for _, xy, _, _ in placed]).reshape(-1, 2), rooms)
        surfaces: list[Surface] = []
        for (body, _, T, local), owner in zip(placed, owners, strict=True):
            bodies.append(replace(body, room_id=owner))
            if owner and body.object_type in CARRYING_TYPES:
                surfaces.extend(_surfaces(body, owner, T, local))
        return House(house_id, digest.hexdigest(), tuple(rooms), tuple(bodies), tuple(surfaces), findings)

    def examine(self, house_id: str) -> Mapping[str, int]:
        """The findings of the house; its meshes are not read. Raises InputError as `load` does for others."""
        return self._instances(self._scene(house_id)[0])[1]

    def _scene(self, house_id: str) -> tuple[JsonNode, bytes]:
        if house_id not in self.scenes:
            raise InputError(self.root, "", f"has no house {house_id!r}", "Give the id of one of its houses.")
        text = read_regular(self.scenes[house_id], _MAX_SCENE_BYTES, _FIX)
        return parse_json(text, str(self.scenes[house_id])), text

    def _instances(self, scene: JsonNode) -> tuple[list[tuple[int, str, JsonNode, F64]], Counter[str]]:
        """(number, template, entry, `T_world_object`) of the objects whose meshes exist, and the findings."""
        found: list[tuple[int, str, JsonNode, F64]] = []
        findings = Counter[str]()
        for number, entry in enumerate(scene.get("object_instances").items(_MAX_OBJECTS)):
            name = _template_name(entry)
            if (self.root / _OBJECTS / f"{name}.glb").is_file():
                found.append((number, name, entry, _pose(entry)))
            else:
                findings["missing meshes"] += 1
        refuse_upside_down(scene, [T for *_, T in found], findings)
        return found, findings

    def _centre_m(self, name: str, template: _Template) -> F64:
        """The point (3,) of a template, z up, that a scene may place: its configured centre of mass, or the
        centre of its bounding box."""
        config = self._config(name)
        centre = None if config is None else config.find("COM")
        if centre is not None:
            return _Y_UP_TO_WORLD[:3, :3] @ _numbers(centre, 3, EXTENT_M)
        return (template.mesh.vertices_m.min(0) + template.mesh.vertices_m.max(0)).astype(np.float64) / 2

    def _config(self, name: str) -> JsonNode | None:
        path = self.root / _CONFIGS / f"{name}.object_config.json"
        return parse_json(read_regular(path, 1 << 20, _FIX), str(path)) if path.is_file() else None

    def _template(self, file: Path) -> _Template:
        if file in self._templates:
            self._templates.move_to_end(file)
            return self._templates[file]
        mesh = read_glb(file).transformed(_Y_UP_TO_WORLD)
        with open_regular(file, MAX_FILE_BYTES, _FIX) as stream:
            digest = hashlib.file_digest(stream, "sha256").digest()
        is_stage = "stages" in file.relative_to(self.root).parts  # the folder above may have any name
        template = _Template(mesh, () if is_stage else convex_parts(mesh), digest)
        self._templates[file] = template
        if len(self._templates) > _KEPT_MESHES:
            self._templates.popitem(last=False)
        return template

    def _placed(
        self, number: int, name: str, template: _Template, T: F64
    ) -> tuple[StaticBody, F64, F64, Mesh]:
        """The body, the point that decides its room, its pose and its mesh in its own frame."""
        mesh = template.mesh.transformed(T)
        parts = tuple((p @ T[:3, :3].T + T[:3, 3]).astype(np.float32) for p in template.parts_m)
        size_m = np.ptp(mesh.vertices_m, axis=0)
        object_type = self._type_of(name)
        is_small = bool(size_m.max() < _SMALL_M or (mesh.vertices_m[:, 2].min() > 0.2 and size_m.max() < 0.6))
        asset_id = PurePosixPath(name).name
        kind = "small" if is_small else "furniture"
        body = StaticBody(f"{number}|{asset_id}", kind, object_type, asset_id, "", mesh, parts)
        middle = (mesh.vertices_m.min(0) + mesh.vertices_m.max(0))[:2] / 2
        return body, middle.astype(np.float64), T, template.mesh

    def _type_of(self, name: str) -> str:
        """The object type by the semantic id of the template's configuration, else by its name."""
        config = self._config(name)
        found = None if config is None else config.find("semantic_id")
        if found is not None:
            known = self.types.get(int(found.number(-1, 1e9)))
            if known is not None:
                return known
        letters = "".join(c for c in PurePosixPath(name).name if c.isalpha()).lower()
        known_types = sorted(CARRYING_TYPES, key=lambda t: -len(t))
        return next((t for t in known_types if t.lower() in letters), "Object")


def open_ai2thor(folder: str) -> Ai2thorHouses:
    """The scenes below a download folder (the one that holds ai2thor-hab, or one above it).

    Hashing every mesh would read many gigabytes, so the source's digest covers the object types and
    the names and sizes of all scenes, meshes and object configurations; each house's own digest
    covers the bytes of its scene and meshes and the types of its objects.
    """
    base = Path(folder)
    fix = "Name it as ai2thor:DIR, where DIR holds ai2thor-hab/ and ai2thorhab-uncompressed/."
    roots = [base, base / "ai2thor", base / "scene_datasets/ai2thor", base / "data/scene_datasets/ai2thor"]
    root = next((r for r in roots if folder and (r / _SCENES).is_dir()), None)
    if root is None:
        raise InputError(folder or "ai2thor", "", "has no folder ai2thor-hab/configs/scenes", fix)
    top = root / _SCENES
    sizes = {p.relative_to(top).as_posix().removesuffix(_SUFFIX): n for p, n in _sizes(top, f"*{_SUFFIX}")}
    if not sizes:
        raise InputError(top, "", "has no scenes", fix)
    listing: list[object] = [[i, sizes[i]] for i in sorted(sizes)]
    patterns = ((_OBJECTS, "*.glb"), (_STAGES, "*.glb"), (_CONFIGS, "*.object_config.json"))
    files = sorted(found for part, pattern in patterns for found in _sizes(root / part, pattern))
    listing += [[p.relative_to(root).as_posix(), n] for p, n in files]
    types = _types(root)
    scenes = {i: top / f"{i}{_SUFFIX}" for i in sorted(sizes)}
    digest = digest_of([listing, sorted(types.items())])
    return Ai2thorHouses(root, digest, scenes, types, read_statement(root))


def _sizes(folder: Path, pattern: str) -> list[tuple[Path, int]]:
    """The files below a folder with their sizes. Raises InputError for too many or unprintable names."""
    try:
        found = [(p, p.stat().st_size) for p in itertools.islice(folder.rglob(pattern), _MAX_FILES + 1)]
    except OSError as error:
        raise InputError(str(error.filename), "", f"cannot be read: {error.strerror}", _FIX) from None
    odd = next((p for p, _ in found if not p.relative_to(folder).as_posix().isprintable()), None)
    if odd is not None:
        raise InputError(odd, "", "has a name with unprintable characters", "Rename the file.")
    if len(found) > _MAX_FILES:
        raise InputError(folder, "", f"has more than {_MAX_FILES:,} files", "Remove some.")
    return sorted(found)


def _types(root: Path) -> dict[int, str]:
    path = root / "ai2thor-hab/configs/object_semantic_id_mapping.json"
    if not path.is_file():
        return {}
    place = str(path)
    value = parse_json(read_regular(path, 1 << 20, _FIX), place).value
    members = cast(dict[str, Any], value) if isinstance(value, dict) else {}
    return {
        int(JsonNode(place, f"$.{k}", v).number(-1, 1e9)): JsonNode(place, "$", k).text()
        for k, v in members.items()
    }


def _template_name(entry: JsonNode) -> str:
    """A template's path below the assets folder; it may not lead out of it."""
    node = entry.get("template_name")
    name = node.text()
    pieces = PurePosixPath(name).parts
    if not pieces or name.startswith("/") or ".." in pieces or "\\" in name or "\0" in name:
        raise node.error(f"{name!r} is not a path below the assets folder")
    return name


def _pose(entry: JsonNode) -> F64:
    """`T_world_object` of an instance."""
    x, y, z = _numbers(entry.get("translation"), 3, EXTENT_M)
    found = entry.find("rotation")
    q = np.array([1.0, 0, 0, 0] if found is None else _numbers(found, 4, 2.0))
    if not 0.5 < np.linalg.norm(q) < 2.0:
        raise entry.get("rotation").error("is not a unit quaternion")
    scale = entry.find("uniform_scale")
    stretched = entry.find("non_uniform_scale")
    factors = np.full(3, 1.0 if scale is None else scale.number(1e-3, 1e3))
    if stretched is not None:
        factors = factors * [n.number(1e-3, 1e3) for n in stretched.items(3)]
    T = np.eye(4)
    T[:3, :3] = rotation_of(q) * factors
    T[:3, 3] = (x, y, z)
    return _in_world(T)


def _numbers(node: JsonNode, count: int, limit: float) -> list[float]:
    values = [n.number(-limit, limit) for n in node.items(count)]
    if len(values) != count:
        raise node.error(f"has {len(values)} numbers, not {count}")
    return values


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
    return Mesh(stage.vertices_m, stage.faces[kept], stage.face_rgb[kept])


def _surfaces(body: StaticBody, room_id: str, T: F64, local: Mesh) -> list[Surface]:
    """Flat tops of an upright, unstretched body."""
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

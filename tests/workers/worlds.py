"""Small hand-made houses, objects and stages for tests, with sizes that are known exactly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from datagen.workers.geometry.mesh import F32, F64, I32, U8, Mesh
from datagen.workers.geometry.transforms import look_at, translation
from datagen.workers.houses.house import BodyKind, House, Room, StaticBody, Surface
from datagen.workers.objects.model import ObjectModel
from datagen.workers.rendering import Camera, SceneGeometry

Vec3 = tuple[float, float, float]
Colour = tuple[int, int, int]

TABLE_TOP_M = 0.75  # height of the top of `table_house`'s table
TABLE_SIZE_M = (1.2, 0.8)
ROOM_M = (4.0, 3.0)  # inner size; the room's corner is at the origin, the table in its middle

_BOX_FACES = np.array(
    [
        [0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4],
        [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5],
    ],
    np.int32,
)  # fmt: skip


def box_vertices(size_m: Vec3, centre_m: Vec3 = (0.0, 0.0, 0.0)) -> F32:
    """The corners (8, 3) of a box; corner k is high along axis a where bit a of k is set."""
    bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
    return ((bits - 0.5) * np.array(size_m) + np.array(centre_m)).astype(np.float32)


def coloured(vertices_m: F32, faces: I32, rgb: Colour) -> Mesh:
    colours: U8 = np.tile(np.array(rgb, np.uint8), (len(faces), 1))
    return Mesh(vertices_m, faces, colours)


def box_mesh(size_m: Vec3, centre_m: Vec3 = (0.0, 0.0, 0.0), rgb: Colour = (180, 120, 60)) -> Mesh:
    """A closed box with outward faces, 12 triangles."""
    return coloured(box_vertices(size_m, centre_m), _BOX_FACES, rgb)


def box_body(
    body_id: str,
    kind: BodyKind,
    object_type: str,
    size_m: Vec3,
    centre_m: Vec3,
    rgb: Colour = (200, 200, 190),
) -> StaticBody:
    """A static box, world frame."""
    room = "" if kind == "wall" else "room|1"
    mesh = box_mesh(size_m, centre_m, rgb)
    return StaticBody(body_id, kind, object_type, "", room, mesh, (box_vertices(size_m, centre_m),))


def model_of(name: str, mesh: Mesh, parts_m: Sequence[F32], mass_kg: float) -> ObjectModel:
    """An object of a mesh and parts whose bounding box is centred on the origin."""
    size = mesh.vertices_m.max(0) - mesh.vertices_m.min(0)
    radius_m = float(np.linalg.norm(mesh.vertices_m, axis=1).max())
    x, y, z = (float(s) for s in size)
    digest = name.encode().hex().ljust(64, "0")[:64]
    return ObjectModel(name, digest, mass_kg, (x, y, z), radius_m, mesh, tuple(parts_m), min(x, y) < 0.08)


def box_model(name: str, size_m: Vec3, mass_kg: float = 0.3, rgb: Colour = (180, 60, 60)) -> ObjectModel:
    """A solid box."""
    return model_of(name, box_mesh(size_m, rgb=rgb), [box_vertices(size_m)], mass_kg)


def cylinder_model(
    name: str,
    radius_m: float,
    height_m: float,
    mass_kg: float = 0.3,
    sides: int = 32,
    rgb: Colour = (60, 90, 180),
) -> ObjectModel:
    """A solid upright prism of `sides` sides (a multiple of four, so that its box is 2 r wide)."""
    angles = 2 * np.pi * np.arange(sides) / sides
    ring = radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    rows = [np.c_[ring, np.full(sides, z)] for z in (-height_m / 2, height_m / 2)]
    vertices = np.concatenate([*rows, [[0, 0, -height_m / 2], [0, 0, height_m / 2]]]).astype(np.float32)
    i, j = np.arange(sides), (np.arange(sides) + 1) % sides
    bottom, top = np.full(sides, 2 * sides), np.full(sides, 2 * sides + 1)
    triangles = [(i, j, j + sides), (i, j + sides, i + sides), (j, i, bottom), (i + sides, j + sides, top)]
    faces = np.concatenate([np.stack(t, axis=1) for t in triangles]).astype(np.int32)
    return model_of(name, coloured(vertices, faces, rgb), [vertices[: 2 * sides]], mass_kg)


def ball_model(name: str, radius_m: float, mass_kg: float = 0.1, rgb: Colour = (70, 160, 70)) -> ObjectModel:
    """A solid ball, as 12 x 24 facets whose poles and equator touch the box."""
    lat = np.linspace(-np.pi / 2, np.pi / 2, 13)
    lon = 2 * np.pi * np.arange(24) / 24
    grid = np.stack(
        [
            np.outer(np.cos(lat), np.cos(lon)),
            np.outer(np.cos(lat), np.sin(lon)),
            np.outer(np.sin(lat), np.ones(24)),
        ],
        axis=2,
    )
    vertices = (radius_m * grid).reshape(-1, 3).astype(np.float32)
    r, c = np.meshgrid(np.arange(12), np.arange(24), indexing="ij")
    a, b, d, e = (((r + dr) * 24 + (c + dc) % 24).ravel() for dr, dc in ((0, 0), (0, 1), (1, 0), (1, 1)))
    faces = np.concatenate([np.stack([a, b, e], 1), np.stack([a, e, d], 1)])
    a, b, d = (vertices[faces[:, k]] for k in range(3))
    faces = faces[np.linalg.norm(np.cross(b - a, d - a), axis=1) > 1e-12].astype(np.int32)  # poles
    return model_of(name, coloured(vertices, faces, rgb), [np.unique(vertices, axis=0)], mass_kg)


def table_house(furniture: Sequence[StaticBody] = ()) -> House:
    """One walled room without ceiling; a table with four legs stands in its middle.

    The floor's top is z = 0; `furniture` is added to what stands in the room.
    """
    (w, d), (tw, td) = ROOM_M, TABLE_SIZE_M
    x, y, thick = w / 2, d / 2, 0.1
    top = 0.04
    legs = [
        box_vertices((0.06, 0.06, TABLE_TOP_M - top), (x + sx, y + sy, (TABLE_TOP_M - top) / 2))
        for sx in (-tw / 2 + 0.05, tw / 2 - 0.05)
        for sy in (-td / 2 + 0.05, td / 2 - 0.05)
    ]
    slab = box_vertices((tw, td, top), (x, y, TABLE_TOP_M - top / 2))
    parts = (slab, *legs)
    faces = np.concatenate([_BOX_FACES + 8 * k for k in range(len(parts))]).astype(np.int32)
    table = StaticBody(
        "table|1", "furniture", "DiningTable", "Table_1", "room|1",
        coloured(np.concatenate(parts), faces, (150, 100, 60)), parts,
    )  # fmt: skip
    floor = box_body("floor|1", "furniture", "Floor", (w, d, thick), (x, y, -thick / 2), (190, 180, 160))
    walls = [
        box_body("wall|1", "wall", "Wall", (w, thick, 2.5), (x, -thick / 2, 1.25), (230, 225, 210)),
        box_body("wall|2", "wall", "Wall", (w, thick, 2.5), (x, d + thick / 2, 1.25), (220, 225, 230)),
        box_body("wall|3", "wall", "Wall", (thick, d, 2.5), (-thick / 2, y, 1.25), (225, 215, 225)),
        box_body("wall|4", "wall", "Wall", (thick, d, 2.5), (w + thick / 2, y, 1.25), (215, 230, 220)),
    ]
    polygon_m: F64 = np.array([[0, 0], [w, 0], [w, d], [0, d]], np.float64)
    surface = Surface(
        "table|1|0", "table|1", "DiningTable", "room|1", translation(x, y, TABLE_TOP_M), TABLE_SIZE_M
    )
    return House(
        "table-house",
        "ab" * 32,
        (Room("room|1", "Kitchen", polygon_m),),
        (floor, *walls, table, *furniture),
        (surface,),
    )


def on_table(model: ObjectModel, dx_m: float = 0.0, dy_m: float = 0.0, lift_m: float = 0.0) -> F64:
    """The pose (4, 4) of an upright object on the table, off its middle by (dx, dy)."""
    return translation(ROOM_M[0] / 2 + dx_m, ROOM_M[1] / 2 + dy_m, TABLE_TOP_M + model.size_m[2] / 2 + lift_m)


def stage_with(
    objects: Sequence[ObjectModel], offsets_m: Sequence[tuple[float, float]], house: House | None = None
) -> SceneGeometry:
    """Objects upright on the table of `table_house`, each off its middle by its (dx, dy)."""
    poses = [on_table(model, dx, dy) for model, (dx, dy) in zip(objects, offsets_m, strict=True)]
    T = np.stack(poses) if poses else np.zeros((0, 4, 4))
    return SceneGeometry(table_house() if house is None else house, tuple(objects), T)


def camera_at(
    eye_m: Vec3, target_m: Vec3, width_px: int = 160, height_px: int = 120, fx_px: float = 150.0
) -> Camera:
    """A camera whose principal point and focal lengths are off the symmetric values, to catch mix-ups."""
    T = look_at(np.array(eye_m), np.array(target_m))
    return Camera(T, width_px, height_px, fx_px, fx_px * 1.05, width_px / 2 + 3.25, height_px / 2 - 2.5)

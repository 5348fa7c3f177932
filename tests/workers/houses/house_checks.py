"""What every house of every source must satisfy."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

from datagen.workers.geometry.planar import inside_polygon
from datagen.workers.houses.house import House, StaticBody


def check_house(house: House) -> None:
    """Ids, shapes, finiteness, orientation, volume: the contract of house.py."""
    assert len(house.digest) == 64
    assert house.rooms
    room_ids = [r.room_id for r in house.rooms]
    assert len(set(room_ids)) == len(room_ids)
    for room in house.rooms:
        p, q = room.polygon_m, np.roll(room.polygon_m, -1, axis=0)
        assert (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum() > 0.1
    body_ids = [b.body_id for b in house.bodies]
    assert len(set(body_ids)) == len(body_ids)
    for body in house.bodies:
        check_body(body)
        assert body.room_id == "" or body.room_id in room_ids
    surface_ids = [s.surface_id for s in house.surfaces]
    assert len(set(surface_ids)) == len(surface_ids)
    for s in house.surfaces:
        T = s.T_world_surface
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.det(T[:3, :3]) > 0.999
        np.testing.assert_allclose(T[2, :3], [0, 0, 1], atol=1e-3)
        assert s.body_id in body_ids
        assert s.room_id in room_ids
        assert min(s.size_m) > 0


def check_body(body: StaticBody) -> None:
    mesh = body.visual
    assert mesh.vertices_m.dtype == np.float32 and mesh.vertices_m.shape[1] == 3
    assert mesh.faces.dtype == np.int32 and mesh.face_rgb.dtype == np.uint8
    assert len(mesh.face_rgb) == len(mesh.faces) > 0
    assert np.isfinite(mesh.vertices_m).all()
    assert mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices_m)
    assert body.convex_parts_m
    for part in body.convex_parts_m:
        assert part.dtype == np.float32
        hull = ConvexHull(part.astype(np.float64))  # raises where the part is flat
        assert hull.volume > 1e-9, body.body_id
        assert len(part) <= 64


def is_convex(points: np.ndarray) -> bool:
    """Whether every point is a corner of, or lies on, the hull of all."""
    hull = ConvexHull(points.astype(np.float64))
    depth = hull.equations[:, :3] @ points.T.astype(np.float64) + hull.equations[:, 3:]
    return bool((depth.max(0) > -1e-5).all())


def signed_volume(body: StaticBody) -> float:
    """By the divergence theorem: the sum of the parts' volumes where all faces look outwards."""
    a, b, c = (body.visual.vertices_m[body.visual.faces[:, k]].astype(np.float64) for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def hull_volume(body: StaticBody) -> float:
    return sum(ConvexHull(p.astype(np.float64)).volume for p in body.convex_parts_m)


def covers(body: StaticBody, xy: tuple[float, float], z: float) -> bool:
    """Whether some convex part holds the point."""
    point = np.array([*xy, z])
    for part in body.convex_parts_m:
        hull = ConvexHull(part.astype(np.float64))
        if (hull.equations[:, :3] @ point + hull.equations[:, 3] <= 1e-6).all():
            return True
    return False


def top_below_m(house: House, surface_id: str, inset: float = 0.9) -> np.ndarray:
    """Height of the carrying body's parts at a 5 x 5 raster of the surface: the highest part there."""
    s = next(s for s in house.surfaces if s.surface_id == surface_id)
    body = next(b for b in house.bodies if b.body_id == s.body_id)
    share = np.linspace(-inset / 2, inset / 2, 5)
    local = np.array([[a * s.size_m[0], b * s.size_m[1], 0, 1] for a in share for b in share])
    points = (local @ s.T_world_surface.T)[:, :2]
    out = np.full(len(points), -np.inf)
    for part in body.convex_parts_m:
        flat = part[:, :2].astype(np.float64)
        hull = flat[ConvexHull(flat).vertices]
        out = np.where(inside_polygon(points, hull), np.maximum(out, part[:, 2].max()), out)
    return out - s.height_m

"""Convex parts: reading, removal of flat parts, volume, and whether a gripper fits around them."""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular
from datagen.workers.foreign_files import START_BYTES, refuse_other_kind
from datagen.workers.geometry.mesh import F32, F64, vertex_components
from datagen.workers.objects.obj_file import MAX_FACES, MAX_FILE_BYTES, read_obj

# A part thinner than this counts as a sheet: physics engines reject it or become unstable.
MIN_THICKNESS_M = 1e-4
MAX_PARTS = 1024
MAX_PART_VERTICES = 10_000  # on one circle they take qhull 20 s, and twice the number four times as long
# A vertex of a part lies at most so far within the part's hull, plus a share of its size.
_MAX_DEPTH_M, _MAX_DEPTH_SHARE = 0.002, 0.02
_MAX_ENCLOSED = 1.2

# Part of a cache key: raise it when `fits_gripper` changes its results.
GRIPPER_VERSION = 1
GRIPPER_STROKE_M = 0.08
# Half a millimetre of clearance on each side while the hand comes down.
MAX_GRASP_WIDTH_M = GRIPPER_STROKE_M - 0.001
# Lower objects have no side that fingertips can hold above the table.
MIN_GRASP_HEIGHT_M = 0.012
MAX_TARGET_MASS_KG = 1.3
# A rim can be held when fingers reach this far down into the opening; plates are shallower.
MIN_OPENING_DEPTH_M = 0.03


@dataclass(frozen=True, eq=False)
class ConvexParts:
    """`vertices_m` holds the hull vertices of each part, (V, 3) each."""

    vertices_m: tuple[F32, ...]
    volume_m3: float  # sum over the parts; parts of a decomposition hardly overlap


def read_convex_parts(path: Path) -> ConvexParts:
    """Reads a convex decomposition: OBJ with one `o` group per part, or PLY.

    Without groups (PLY, plain OBJ) each connected component is a part, which is how SAPIEN splits
    such files too. Raises InputError naming the file: unreadable, no faces, only flat parts, parts that
    are not convex, more than `MAX_PARTS` parts.
    """
    if path.suffix.lower() == ".ply":
        vertices, groups = _read_ply(path)
    else:
        mesh = read_obj(path)
        vertices, groups = mesh.vertices, mesh.group_faces()
    if len(groups) == 1:
        groups = components(groups[0], len(vertices))
    if len(groups) > MAX_PARTS:
        raise InputError(
            path,
            "",
            f"{len(groups)} convex parts, more than the {MAX_PARTS} allowed",
            "Merge them to a coarser decomposition",
        )
    for number, faces in enumerate(groups, 1):
        if problem := not_convex(vertices, faces):
            fix = "Give a convex decomposition, one `o` group for each part, not the visual mesh"
            raise InputError(path, f"part {number}", problem, fix)
    parts = convex_parts(vertices[np.unique(faces)] for faces in groups)
    if not parts.vertices_m:
        raise InputError(path, "", "every collision part is flat", "Give convex parts with volume")
    return parts


def convex_parts(points_m: Iterable[npt.NDArray[np.floating]]) -> ConvexParts:
    """The hulls of point sets, each (V, 3); sets without volume are dropped."""
    kept: list[F32] = []
    volume = 0.0
    for points in points_m:
        try:
            hull = ConvexHull(np.asarray(points, np.float64))
        except (QhullError, ValueError):
            continue
        if hull.volume >= MIN_THICKNESS_M * hull.area / 2:
            volume += float(hull.volume)
            kept.append(np.asarray(points, np.float32)[np.sort(hull.vertices)])
    return ConvexParts(tuple(kept), volume)


def not_convex(vertices: F64, faces: npt.NDArray[np.int64]) -> str:
    """The problem of a part that its hull does not stand for; "" if the hull does, or the part is flat."""
    points_m = vertices[np.unique(faces)]
    if len(points_m) > MAX_PART_VERTICES:
        return f"has more than {MAX_PART_VERTICES:,} vertices"
    try:
        hull = ConvexHull(points_m)
    except (QhullError, ValueError):
        return ""
    depth_m = 0.0
    for start in range(0, len(points_m), 4096):
        heights = points_m[start : start + 4096] @ hull.equations[:, :3].T + hull.equations[:, 3]
        depth_m = max(depth_m, float(-heights.max(axis=1).min()))
    if depth_m > _MAX_DEPTH_M + _MAX_DEPTH_SHARE * np.ptp(points_m, axis=0).max():
        return f"not convex: a vertex lies {1000 * depth_m:.0f} mm within its hull"
    # Cones from a point within to the faces fill a convex body once, whatever the order of corners.
    corners = vertices[np.unique(np.sort(faces, axis=1), axis=0)] - points_m[hull.vertices].mean(axis=0)
    enclosed = float(np.abs(np.linalg.det(corners)).sum()) / 6
    if enclosed > _MAX_ENCLOSED * hull.volume:
        return f"not convex: its surface encloses its hull {enclosed / hull.volume:.1f} times"
    return ""


def _read_ply(path: Path) -> tuple[F64, list[npt.NDArray[np.int64]]]:
    # Imported here: the import takes as long as a short command, and few objects are PLY files.
    import trimesh

    data = read_regular(path, MAX_FILE_BYTES, "Give a PLY file of a simplified mesh")
    refuse_other_kind(path, data[:START_BYTES], "a PLY file", "Export the parts as PLY")
    try:
        mesh = trimesh.load_mesh(io.BytesIO(data), file_type="ply", process=False)
        vertices = np.asarray(mesh.vertices, np.float64)
        faces = np.asarray(mesh.faces, np.int64)
    # The reader raises any of these for a damaged PLY file.
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, MemoryError) as error:
        raise InputError(path, "", f"not a PLY mesh ({type(error).__name__})", "Export it again") from error
    if len(faces) == 0 or len(faces) > MAX_FACES:
        raise InputError(path, "", f"the mesh has {len(faces):,} faces", f"Give 1 to {MAX_FACES:,} faces")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(path, "", "a face refers to a missing vertex", "Export the mesh again")
    if not np.isfinite(vertices).all():
        raise InputError(path, "", "a vertex is not finite", "Export the mesh again")
    return vertices, [faces]


def components(faces: npt.NDArray[np.int64], n_vertices: int) -> list[npt.NDArray[np.int64]]:
    """The faces (F, 3) of each piece that shares no vertex with others."""
    of_face = vertex_components(faces, n_vertices)[faces[:, 0]]
    order = np.argsort(of_face, kind="stable")
    cuts = np.flatnonzero(np.diff(of_face[order])) + 1
    # In order of first appearance in the file, as groups are.
    return sorted(np.split(faces[order], cuts), key=lambda part: int(part.min()))


def fits_gripper(
    visual_m: F32,  # (V, 3), object frame, z up at rest
    parts: ConvexParts,
    mass_kg: float,
) -> bool:
    """Whether an 8 cm parallel gripper can pick the object up from a table where it stands upright.

    The fingers close in a horizontal direction, so the smallest width of the hull's outline seen
    from above, or, for open vessels, the rim, must fit. The mass limit leaves margin
    below a Panda's 3 kg payload at a long reach.
    """
    points = np.concatenate(parts.vertices_m).astype(np.float64)
    height_m = float(np.ptp(points[:, 2]))
    if mass_kg > MAX_TARGET_MASS_KG or height_m < MIN_GRASP_HEIGHT_M:
        return False
    return (
        outline_width(points[:, :2]) <= MAX_GRASP_WIDTH_M
        or opening_depth(visual_m, parts.vertices_m) >= MIN_OPENING_DEPTH_M
    )


def outline_width(points_m: F64) -> float:
    """The smallest distance between two parallel lines around (N, 2) points, metres.

    It is attained with one line along an edge of the convex hull (rotating calipers).
    """
    corners = points_m[ConvexHull(points_m).vertices]
    edges = np.roll(corners, -1, axis=0) - corners
    normals = np.stack([-edges[:, 1], edges[:, 0]], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    reach = corners @ normals.T
    return float((reach.max(axis=0) - reach.min(axis=0)).min())


def opening_depth(visual_m: F32, parts_m: tuple[F32, ...]) -> float:
    """How far an upright object's middle lies below its rim, metres: 0 unless it is an open vessel.

    Looks at the visual vertices within half the rim's smaller half-width around the rim's axis. It
    is a vessel only if the rim goes all the way round (each of 12 sectors rises above the middle)
    and if the convex parts leave the opening free, so that fingers can enter it in physics too.
    """
    points = visual_m.astype(np.float64)
    top = float(points[:, 2].max())
    rim = points[points[:, 2] > top - 0.25 * np.ptp(points[:, 2])]
    centre = (rim[:, :2].max(axis=0) + rim[:, :2].min(axis=0)) / 2
    offset = points[:, :2] - centre
    radius = np.hypot(offset[:, 0], offset[:, 1])
    inside = radius < 0.25 * np.ptp(rim[:, :2], axis=0).min()
    if not inside.any():
        return 0.0
    depth = top - float(points[inside, 2].max())
    sector = ((np.arctan2(offset[:, 1], offset[:, 0]) + np.pi) / (2 * np.pi) * 12).astype(int) % 12
    raised = np.unique(sector[~inside & (points[:, 2] > top - 0.5 * depth)])
    if len(raised) < 12:
        return 0.0
    middle = np.array([centre[0], centre[1], top - depth / 2, 1.0])
    filled = any(bool(np.all(ConvexHull(part).equations @ middle <= 0)) for part in parts_m)
    return 0.0 if filled else depth

"""Read one scanned object, from its files or from the cache."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.identity import digest_of
from datagen.schemas.safe_files import open_regular
from datagen.workers.content_cache import Arrays, CacheFolder
from datagen.workers.geometry.mesh import F32, Mesh, Texture
from datagen.workers.objects.convex import ConvexParts, fits_gripper, read_convex_parts
from datagen.workers.objects.model import ObjectModel
from datagen.workers.objects.obj_file import MAX_FILE_BYTES, ObjMesh, read_obj
from datagen.workers.objects.texture import face_colours, read_texture, texture_of_materials

# Part of every digest: raise it when the same files, if they were read before, are read differently.
READER_VERSION = 1
# Part of every cache key: raise it also when files are refused that were read before.
_CACHE_VERSION = 2
# A mesh stands where its lowest point is within the first of 0, and does not beyond the second.
_STANDS_M = (0.01, 0.015)
MIN_SIZE_M = 0.002
MAX_SIZE_M = 2.0
CACHE = CacheFolder("objects", most_files=4096)
_VOLUMES = CacheFolder("volumes", most_files=64)


@dataclass(frozen=True)
class ScanFiles:
    """The files of one object and the sha256 over their bytes."""

    visual: Path
    texture: Path
    collision: Path
    digest: str


@dataclass(frozen=True, eq=False)
class Scan:
    """Mesh and convex parts in one frame: origin at the centre of the visual's bounding box."""

    visual: Mesh
    parts: ConvexParts
    size_m: tuple[float, float, float]


def scan_files(visual: Path, texture: Path, collision: Path) -> ScanFiles:
    """Hashes the three files. Raises InputError that names a missing or unreadable one."""
    digests: list[str] = []
    for path in (visual, texture, collision):
        with open_regular(path, MAX_FILE_BYTES, "Fetch or restore the asset") as file:
            digests.append(hashlib.file_digest(file, "sha256").hexdigest())
    return ScanFiles(visual, texture, collision, digest_of(digests))


def load_scan(files: ScanFiles) -> Scan:
    """The scan, from the cache if it is there, else from the files (and then cached).

    Raises InputError as `read_scan` does; an unusable cache costs only time.
    """
    paths = files.visual, files.texture, files.collision
    key = f"{files.digest}-{_CACHE_VERSION}"
    return restored_scan(CACHE.computed(key, lambda: stored_scan(read_scan(*paths))))


def volumes_m3(files: Sequence[ScanFiles]) -> list[float]:
    """The volume of each scan's convex parts, cached in one file: a worker opens hundreds.

    Raises InputError as `read_scan` does.
    """
    key = f"{digest_of([scan.digest for scan in files])}-{_CACHE_VERSION}"
    volumes = _VOLUMES.computed(
        key, lambda: {"volumes_m3": np.array([load_scan(scan).parts.volume_m3 for scan in files], np.float64)}
    )
    return volumes["volumes_m3"].tolist()


def read_scan(visual: Path, texture: Path, collision: Path) -> Scan:
    """Reads and joins the files of one object.

    Vertices that carry several texture coordinates are split, so that `uv` has one per vertex.
    Raises InputError naming the file: see `read_obj`, `read_texture` and `read_convex_parts`, and
    a mesh without texture coordinates, of several textures, of absurd size, that lies on its side, or away
    from its collision parts.
    """
    mesh = read_obj(visual)
    if (mesh.uv_faces < 0).any():
        raise InputError(visual, "f", "a face has no texture coordinates", "Export the mesh with UVs")
    if len(mesh.materials) > 1:
        _refuse_other_textures(visual, mesh)
    used = mesh.vertices[np.unique(mesh.faces)]
    low, high = used.min(axis=0), used.max(axis=0)
    size = high - low
    if np.abs(used).max() > 100 or size.max() > MAX_SIZE_M or size.max() < MIN_SIZE_M:
        raise InputError(
            visual,
            "v",
            f"the mesh spans {size.max():.4g} m, where {MIN_SIZE_M} to {MAX_SIZE_M} m are expected",
            "Scale the mesh to metres",
        )
    if size[1] > _STANDS_M[1] and abs(low[1]) < _STANDS_M[0] and low[2] < -_STANDS_M[1]:
        problem = f"y is up: the mesh stands on y = {low[1]:.3f} and reaches down to z = {low[2]:.3f} m"
        raise InputError(visual, "v", problem, "Export both meshes with z up")
    centre = (low + high) / 2
    vertices, uv, faces = _split_seams(mesh)
    image = read_texture(texture)
    colours = face_colours(image, uv, faces)
    vertices_m = (vertices - centre).astype(np.float32)

    parts = read_convex_parts(collision)
    corners = np.concatenate(parts.vertices_m)
    gap = max(np.abs(corners.min(axis=0) - low).max(), np.abs(corners.max(axis=0) - high).max())
    # Decompositions are a little larger or smaller than the scan (8.5 mm at most in the YCB set).
    if gap > 0.01 + 0.05 * size.max():
        raise InputError(
            collision,
            "v",
            f"its bounding box is {gap:.3g} m off that of the visual mesh",
            "Give both meshes in one frame and unit",
        )
    centred = tuple((part - centre).astype(np.float32) for part in parts.vertices_m)
    return Scan(
        Mesh(vertices_m, faces, colours, Texture(image, uv)),
        ConvexParts(centred, parts.volume_m3),
        (float(size[0]), float(size[1]), float(size[2])),
    )


def _refuse_other_textures(visual: Path, mesh: ObjMesh) -> None:
    """Raise InputError unless the library gives all materials of the faces one image."""
    name = mesh.material_library
    if not name or Path(name).is_absolute() or ".." in Path(name).parts or "\0" in name:
        problem = f"{len(mesh.materials)} materials, and {name[:80]!r} is no library inside the folder"
        raise InputError(visual, "mtllib", problem, "Bake the mesh into one texture")
    texture_of_materials(visual.parent / name, mesh.materials)


def _split_seams(mesh: ObjMesh) -> tuple[np.ndarray, F32, np.ndarray]:
    """One vertex for each used (vertex, texture coordinate) pair: (V, 3), (V, 2), faces (F, 3)."""
    keys = mesh.faces * len(mesh.uv) + mesh.uv_faces
    pairs, faces = np.unique(keys, return_inverse=True)
    vertex, uv = np.divmod(pairs, len(mesh.uv))
    return (mesh.vertices[vertex], mesh.uv[uv].astype(np.float32), faces.reshape(-1, 3).astype(np.int32))


def stored_scan(scan: Scan) -> Arrays:
    """The arrays of a scan, as caches hold them."""
    texture = scan.visual.texture
    textured = {} if texture is None else {"image": texture.image, "uv": texture.uv}
    return {
        "vertices": scan.visual.vertices_m,
        "faces": scan.visual.faces,
        "face_rgb": scan.visual.face_rgb,
        **textured,
        "part_vertices": np.concatenate(scan.parts.vertices_m),
        "part_cuts": np.cumsum([len(part) for part in scan.parts.vertices_m])[:-1],
        "volume": np.array(scan.parts.volume_m3, np.float64),
        "size_m": np.array(scan.size_m),
    }


def restored_scan(stored: Arrays) -> Scan:
    """The scan of the arrays that `stored_scan` returns."""
    texture = Texture(stored["image"], stored["uv"]) if "image" in stored else None
    parts = tuple(np.split(stored["part_vertices"], stored["part_cuts"]))
    width, depth, height = (float(length) for length in stored["size_m"])
    return Scan(
        Mesh(stored["vertices"], stored["faces"], stored["face_rgb"], texture),
        ConvexParts(parts, float(stored["volume"])),
        (width, depth, height),
    )


def model_of(name: str, digest: str, mass_kg: float, scan: Scan) -> ObjectModel:
    """The object of a scan."""
    return ObjectModel(
        name=name,
        digest=digest,
        mass_kg=mass_kg,
        size_m=scan.size_m,
        radius_m=float(np.linalg.norm(scan.visual.vertices_m.astype(np.float64), axis=1).max()),
        visual=scan.visual,
        convex_parts_m=scan.parts.vertices_m,
        can_be_target=fits_gripper(scan.visual.vertices_m, scan.parts, mass_kg),
    )

"""Surfaces of mesh files with their colours: OBJ, glTF, PLY, STL, COLLADA and MuJoCo's MSH."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt
from PIL import Image

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import is_inside, read_regular
from datagen.workers.extras import how_to_get
from datagen.workers.geometry.mesh import F64, U8, Mesh, Texture, transformed
from datagen.workers.houses.glb import DAMAGE, MAX_FACES, read_pieces
from datagen.workers.objects.obj_file import read_obj
from datagen.workers.objects.texture import (
    Material,
    face_colours,
    read_materials,
    read_texture,
    reduced_image,
)

I64 = npt.NDArray[np.int64]

SUFFIXES = (".glb", ".gltf", ".obj", ".dae", ".ply", ".stl", ".msh")
_MAX_BYTES = 256 << 20
_FARTHEST = 1e6
_FIX = "Export the mesh again"
_PLAIN = np.array((178, 178, 178), np.uint8)
# Side of each image in an atlas, by the most images that it then holds.
_SIDES_PX = {4: 512, 16: 256, 64: 128}
_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles whose corners have texture coordinates of their own, so that surfaces can be joined."""

    vertices: F64  # (V, 3)
    faces: I64  # (F, 3)
    rgb: U8  # (F, 3), the colour where there is no image
    image: I64  # (F,) row of `images`, -1 for a plain colour
    uv: F64  # (F, 3, 2), origin at the image's lower left corner
    images: tuple[U8, ...]
    cuts: I64  # (G,) first faces of the file's groups but the first

    def moved(self, T: F64, scale: float | F64 = 1.0) -> Surface:
        """The surface scaled, then moved by T (4, 4); faces of a mirrored one are turned over."""
        moved = replace(self, vertices=transformed(self.vertices * scale, T))
        return moved if np.prod(np.broadcast_to(scale, 3)) > 0 else moved.turned()

    def turned(self) -> Surface:
        return replace(self, faces=self.faces[:, ::-1], uv=self.uv[:, ::-1])

    def painted(self, rgb: Sequence[float] | None, image: U8 | None = None) -> Surface:
        """The surface with a colour (0 to 1) or an image for faces that have none of their own."""
        bare = (self.image < 0) & (self.rgb == _PLAIN).all(axis=1)
        if image is not None and self.uv[bare].any():
            rows = np.where(bare, len(self.images), self.image)
            return replace(self, image=rows, images=(*self.images, image))
        colours = self.rgb.copy()
        if rgb is not None:
            colours[bare] = _rgb_of(rgb)
        return replace(self, rgb=colours)


def joined(surfaces: Sequence[Surface]) -> Surface:
    """One surface of all, each a group of its own."""
    if len(surfaces) == 1:
        return surfaces[0]
    at = np.cumsum([0] + [len(s.vertices) for s in surfaces])
    row = np.cumsum([0] + [len(s.images) for s in surfaces])
    face = np.cumsum([0] + [len(s.faces) for s in surfaces])
    return Surface(
        np.concatenate([s.vertices for s in surfaces]),
        np.concatenate([s.faces + at[k] for k, s in enumerate(surfaces)]),
        np.concatenate([s.rgb for s in surfaces]),
        np.concatenate([np.where(s.image < 0, -1, s.image + row[k]) for k, s in enumerate(surfaces)]),
        np.concatenate([s.uv for s in surfaces]),
        tuple(image for s in surfaces for image in s.images),
        np.concatenate([*(s.cuts + face[k] for k, s in enumerate(surfaces)), face[1:-1]]),
    )


def _rgb_of(colour: Sequence[float]) -> U8:
    return np.rint(np.clip(colour, 0, 1) * np.array(255.0)).astype(np.uint8)


def plain_surface(vertices: Any, faces: Any, rgb: Any = _PLAIN, cuts: Any = ()) -> Surface:
    """A surface without images; `rgb` is one colour or (F, 3)."""
    n = len(faces)
    colours = np.broadcast_to(np.asarray(rgb, np.uint8), (n, 3))
    points, corners = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    return Surface(
        points, corners, colours, np.full(n, -1), np.zeros((n, 3, 2)), (), np.asarray(cuts, np.int64)
    )


class SurfaceReader:
    """Reads meshes within a folder; `said` holds by cause what they lack, `materials` their names."""

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()
        self.said: dict[str, str] = {}
        self.materials: set[str] = set()

    def inside(self, path: Path) -> Path:
        """The path. Raises InputError where it leads out of the folder."""
        if is_inside(self.root, path):
            return path
        raise InputError(path, "", "is not inside the folder of the objects", "Copy it there")

    def read(self, path: Path) -> Surface:
        """The surface in the file's unit, glTF and COLLADA turned to z up, COLLADA in metres.

        Raises InputError naming the file: missing, damaged, outside the folder, without faces, too large.
        """
        kind = self.inside(path).suffix.lower()
        try:
            if kind == ".obj":
                surface = self._obj(path)
            elif kind == ".msh":
                surface = _msh(path)
            elif kind in SUFFIXES:
                pieces = read_pieces(path, kind[1:], _Beside(self, path))
                surface = joined([self._piece(path, piece) for piece in pieces])
                surface = surface.moved(*_frame(path, kind))
            else:
                raise InputError(
                    path, "", "is no mesh that is read", f"Export it as one of {', '.join(SUFFIXES)}"
                )
        except ImportError as error:
            raise InputError(path, "", f"needs {error.name or 'a reader'}", how_to_get("robots")) from None
        except DAMAGE + (MemoryError,) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(path, "", f"is not a readable mesh ({type(error).__name__})", _FIX) from None
        return _checked(path, surface)

    def image(self, path: Path, name: str) -> U8 | None:
        """The image that a mesh names; None, and said, where it is missing or unreadable."""
        try:
            return read_texture(self._find(path, name))
        except InputError as error:
            self.said["texture missing"] = f"{name[-60:]} {error.problem}"
            return None

    def _find(self, mesh: Path, name: str) -> Path:
        """Next to the mesh, or where Gazebo and the Google Scanned Objects have it."""
        last = name.replace("\\", "/").rpartition("/")[2]
        near = (mesh.parent / name, mesh.parent / last, mesh.parent.parent / "materials" / "textures" / last)
        return self.inside(next((p for p in near if "\0" not in name and p.is_file()), near[0]))

    def _obj(self, path: Path) -> Surface:
        mesh = read_obj(path)
        surface = plain_surface(mesh.vertices, mesh.faces, cuts=mesh.group_starts[mesh.group_starts > 0])
        has_uv = np.all(mesh.uv_faces >= 0, axis=1)
        if has_uv.any():
            uv = np.where(has_uv[:, None, None], mesh.uv[np.maximum(mesh.uv_faces, 0)], 0.0)
            surface = replace(surface, uv=uv)
        materials: dict[str, Material] = {}
        if mesh.material_library:
            try:
                materials = read_materials(self._find(path, mesh.material_library))
            except InputError as error:
                self.said["texture missing"] = f"{mesh.material_library[-60:]} {error.problem}"
        self.materials |= {*mesh.materials}
        starts = mesh.material_starts or ((0, next(iter(materials), "")),)
        rows: dict[str, int] = {}
        images: list[U8] = []
        rgb, image = surface.rgb.copy(), surface.image
        for (start, name), end in zip(starts, [s for s, _ in starts[1:]] + [len(mesh.faces)], strict=True):
            if (material := materials.get(name)) is None:
                continue
            rgb[start:end] = _rgb_of(material.rgb)
            if material.image and material.image not in rows:
                pixels = self.image(path, material.image)
                rows[material.image] = -1 if pixels is None else len(images)
                images += [] if pixels is None else [pixels]
            if material.image:
                image[start:end] = np.where(has_uv[start:end], rows[material.image], -1)
        return replace(surface, rgb=rgb, image=image, images=tuple(images))

    def _piece(self, path: Path, piece: Any) -> Surface:
        """A mesh of trimesh: colours of vertices or faces, else its material's image times its colour."""
        visual = piece.visual
        if visual.kind in ("vertex", "face"):
            return plain_surface(piece.vertices, piece.faces, np.asarray(visual.face_colors)[:, :3])
        material, uv = getattr(visual, "material", None), getattr(visual, "uv", None)
        self.materials.add(str(getattr(material, "name", None) or ""))
        factor = getattr(material, "baseColorFactor", None)
        if factor is None:
            factor = getattr(material, "diffuse", None)
        tint = np.asarray(_PLAIN if factor is None else factor)[:3]
        tint = tint * 255.0 if tint.dtype.kind == "f" and factor is not None else tint.astype(np.float64)
        surface = plain_surface(piece.vertices, piece.faces, np.clip(tint, 0, 255))
        image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
        if image is None or uv is None or len(uv) != len(piece.vertices):
            return surface
        pixels = reduced_image(image, path)
        if hasattr(material, "baseColorTexture") and factor is not None:
            pixels = (pixels * (np.clip(tint, 0, 255) / 255)).astype(np.uint8)
        corners = np.asarray(uv, np.float64)[surface.faces]
        return replace(surface, uv=corners, image=np.zeros(len(surface.faces), np.int64), images=(pixels,))


class _Beside:
    """What trimesh asks for the images and buffers of a mesh; other files are not read."""

    def __init__(self, reader: SurfaceReader, mesh: Path) -> None:
        self.reader, self.mesh, self.left_bytes = reader, mesh, _MAX_BYTES

    def __getitem__(self, name: str) -> bytes:
        return self.get(unquote(name))  # glTF names files by URIs

    def get(self, name: str) -> bytes:
        """A buffer, or a PNG of the image, grey where it is missing. InputError for a missing buffer."""
        if name.lower().endswith(".bin"):
            data = read_regular(self.reader.inside(self.mesh.parent / name), self.left_bytes, _FIX)
            self.left_bytes -= len(data)
            return data
        pixels = self.reader.image(self.mesh, name) if name[-4:].lower() in (".png", ".jpg", "jpeg") else None
        out = io.BytesIO()
        Image.fromarray(np.full((1, 1, 3), 178, np.uint8) if pixels is None else pixels).save(out, "PNG")
        return out.getvalue()


def _frame(path: Path, kind: str) -> tuple[F64, float]:
    """How the frame that a format states leads to z up and metres."""
    if kind != ".dae":
        return (_Y_UP if kind in (".glb", ".gltf") else np.eye(4)), 1.0
    from collada import Collada

    about: Any = Collada(str(path), ignore=[Exception]).assetInfo
    return (np.eye(4) if about.upaxis == "Z_UP" else _Y_UP), float(about.unitmeter or 1.0)


def _msh(path: Path) -> Surface:
    """MuJoCo's format: numbers of vertices, normals, texture coordinates and faces, then their values."""
    data = read_regular(path, _MAX_BYTES, _FIX)
    vertices, normals, uvs, faces = (int(n) for n in np.frombuffer(data[:16], "<i4"))
    if min(vertices, normals, uvs, faces) < 0 or len(data) != 16 + 4 * (
        3 * vertices + 3 * normals + 2 * uvs + 3 * faces
    ):
        raise InputError(path, "", "its length differs from its header's", _FIX)
    values = np.frombuffer(data, "<f4", offset=16).astype(np.float64)
    corners = np.frombuffer(data[len(data) - 12 * faces :], "<i4").reshape(-1, 3)
    surface = plain_surface(values[: 3 * vertices].reshape(-1, 3), corners)
    if uvs != vertices or not faces or corners.min() < 0 or corners.max() >= vertices:
        return surface
    start = 3 * vertices + 3 * normals
    uv = values[start : start + 2 * uvs].reshape(-1, 2) * (1, -1) + (0, 1)  # from the upper left corner
    return replace(surface, uv=uv[corners])


def _checked(path: Path, surface: Surface) -> Surface:
    """The surface without faces of no area. Raises InputError for what no consumer could use."""
    faces = surface.faces
    if not 0 < len(faces) <= MAX_FACES:
        raise InputError(path, "", f"has {len(faces):,} faces", f"Simplify it to {MAX_FACES:,} faces")
    if faces.min() < 0 or faces.max() >= len(surface.vertices):
        raise InputError(path, "", "a face refers to a missing vertex", _FIX)
    if not (np.abs(surface.vertices) <= _FARTHEST).all():
        raise InputError(path, "", f"a vertex is not finite, or beyond {_FARTHEST:,.0f}", _FIX)
    if not np.isfinite(surface.uv).all():
        raise InputError(path, "", "a texture coordinate is not finite", _FIX)
    return surface


def mesh_of(surface: Surface) -> Mesh:
    """The mesh in metres: one texture, an atlas of several images, or none."""
    uv, images, image = surface.uv, list(surface.images), surface.image
    if not (image >= 0).any():
        used, faces = np.unique(surface.faces, return_inverse=True)
        vertices = surface.vertices[used].astype(np.float32)
        return Mesh(vertices, faces.reshape(-1, 3).astype(np.int32), np.ascontiguousarray(surface.rgb))
    if len(images) > 1 or (image < 0).any():
        atlas, uv = _atlas(surface)
    else:
        atlas = images[0]
    corners = np.column_stack([surface.faces.reshape(-1), uv.astype(np.float32).reshape(-1, 2)])
    rows, faces = np.unique(corners, axis=0, return_inverse=True)
    faces, uv = faces.reshape(-1, 3).astype(np.int32), rows[:, 1:].astype(np.float32)
    vertices = surface.vertices[rows[:, 0].astype(np.int64)].astype(np.float32)
    return Mesh(vertices, faces, face_colours(atlas, uv, faces), Texture(atlas, uv))


def _atlas(surface: Surface) -> tuple[U8, F64]:
    """All images below each other, the plain colours as a last one, and coordinates (F, 3, 2) in it.

    Images that a face repeats are not repeated: its coordinates end at their edges.
    """
    plain = surface.image < 0
    colours, which = np.unique(surface.rgb[plain] & 0xF8, axis=0, return_inverse=True)
    side = next((px for most, px in _SIDES_PX.items() if len(surface.images) <= most), 64)
    blocks = [
        np.asarray(Image.fromarray(i).resize((side, side), Image.Resampling.BOX)) for i in surface.images
    ]
    swatch = np.zeros((-(-max(1, len(colours)) // side), side, 3), np.uint8)
    swatch.reshape(-1, 3)[: len(colours)] = colours
    atlas = np.concatenate([*blocks, swatch])
    uv = surface.uv - np.floor(surface.uv.min(axis=1, keepdims=True))
    pixel = np.clip(uv, 0, 1) * (side - 1) + 0.5
    column, row = pixel[..., 0], side * (surface.image[:, None] + 1) - pixel[..., 1]
    column[plain] = (which.reshape(-1) % side + 0.5)[:, None]
    row[plain] = (len(blocks) * side + which.reshape(-1) // side + 0.5)[:, None]
    return atlas, np.stack([column / side, 1 - row / len(atlas)], axis=2)

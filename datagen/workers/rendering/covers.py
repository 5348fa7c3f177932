"""What covers a house in pictures: patterns, by the names of materials, and textures of its meshes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from datagen.workers.furniture.asset_geometry import SHAPES
from datagen.workers.furniture.solids import hash_bytes
from datagen.workers.geometry.mesh import F32, I32, U8
from datagen.workers.houses.house import House, StaticBody
from datagen.workers.objects.surfaces import Surface, SurfaceReader

I16 = npt.NDArray[np.int16]
# Length, width, joint of cells (m), shift of a row (cells); shares of the colour: that of joints, spread of
# cells, veins along them; distance of veins (m). Then a seed, and whether cells of level faces lie along y.
_PLANKS, _GRAIN = (1.3, 0.13, 0.004, 0.37, 0.5, 0.11, 0.05, 0.03), (9.0, 9.0, 0.0, 0.0, 1.0, 0.0, 0.07, 0.03)
_PATTERNS = {  # by the first of these words in the name of a material
    "brick": (0.22, 0.075, 0.01, 0.5, 1.3, 0.14, 0.02, 0.02),
    "tile": (0.3, 0.3, 0.005, 0.0, 0.75, 0.03, 0.01, 0.3),
    **dict.fromkeys(("marble", "granite"), (0.8, 0.8, 0.002, 0.0, 0.85, 0.03, 0.02, 0.4)),
    **dict.fromkeys(("wood", "plank", "parquet", "floor", "cabinet"), _PLANKS),
}
_PLAIN = (*_GRAIN[:6], 0.0, 1.0, 0, 0)
_WOODEN = {t for t, (_, palette) in SHAPES.items() if palette == SHAPES["Desk"][1]} - {"Painting"} | {"Door"}
_FARTHEST = 1e4  # coordinate on an image; differences of larger ones may not be finite
_RANDOM = np.random.default_rng(0).uniform(-1, 1, 256).astype(np.float32)


@dataclass(frozen=True, eq=False)
class HouseTextures:
    """The images of a house's meshes, and where its faces lie on them."""

    texels: U8  # (T, 3), rows of all images, one image after the other
    images: I32  # (3, K): first texel, height and width
    image: I32  # (F,), -1 without
    uv: F32  # (6, F): u of the first corner, from it to the others; the same of v

    def paint(self, rgb: U8, face: I32, barycentric: F32) -> None:
        """Set the colours (N, 3) of points of faces (N,) that have a texture."""
        image = self.image.take(face)
        rows = np.flatnonzero(image >= 0)
        first, height, width = self.images.take(image.take(rows), axis=1)
        b, c = barycentric.take(rows, axis=0).T
        u, u_b, u_c, v, v_b, v_c = self.uv.take(face.take(rows), axis=1)
        u, v = u + b * u_b + c * u_c, v + b * v_b + c * v_c
        column = np.minimum(((u - np.floor(u)) * width).astype(np.int32), width - 1)
        row = np.minimum(((1 - v + np.floor(v)) * height).astype(np.int32), height - 1)
        rgb[rows] = self.texels.take(first + row * width + column, axis=0)


@dataclass(frozen=True, eq=False)
class Cover:
    """The patterns (10, K) of a house, the first plain, and those of its faces (F,); and its textures."""

    patterns: F32
    pattern: I16
    textures: HouseTextures | None

    def shares(self, pattern: I16, points_m: F32, normals: F32, seen_m: F32) -> F32:
        """Shares (N,) of the colours at points (3, N) of patterns; pixels show `seen_m` (N,) of them."""
        values = self.patterns.take(pattern, axis=1)
        length_m, width_m, joint_m, shift, joint, spread, vein, vein_m, seed, turned = values
        (x, y, z), (nx, ny, nz) = points_m, normals
        level, turned = np.abs(nz) > 0.7, turned > 0
        u_m = np.where(level, np.where(turned, y, x), y * nx - x * ny)
        v_m = np.where(level, np.where(turned, x, y), z)
        row = np.floor(v_m / width_m)
        u = u_m / length_m + shift * row
        column = np.floor(u)
        cell = _RANDOM[(37 * row + 101 * column + seed).astype(np.int32) & 255]
        wave = v_m * 6.28 / vein_m + 40 * cell + 3 * np.sin(2 * u_m + 9 * cell)
        # A pixel that shows more than a detail has its mean: far floors would flicker.
        shares = vein * np.sin(wave) * np.sin(0.37 * wave) * np.clip(vein_m / seen_m - 1.5, 0, 1)
        shares += spread * cell * np.clip(width_m / seen_m - 1, 0, 1) + 1
        along_m, across_m = (0.5 - np.abs(u - column - 0.5)) * length_m, np.abs(v_m - (row + 0.5) * width_m)
        edge_m = np.minimum(along_m, width_m / 2 - across_m)
        shown_m = np.clip((joint_m + seen_m) / 2 - edge_m, 0, np.minimum(joint_m, seen_m))
        return shares + (joint - shares) * shown_m / seen_m


@lru_cache(maxsize=2)
def house_cover(house: House) -> Cover:
    """The patterns of all bodies' faces, in order."""
    known: dict[tuple[float, ...], int] = {_PLAIN: 0}
    rows: list[int] = []
    for body in house.bodies:
        colours = [(r, g, b) for r, g, b in body.visual.face_rgb.tolist()]
        found = {rgb: _pattern(house, body, rgb) for rgb in set(colours)} if house.materials else {}
        rows += [known.setdefault(found.get(rgb, _PLAIN), len(known)) for rgb in colours]
    return Cover(np.array(list(known), np.float32).T.copy(), np.array(rows, np.int16), _textures(house))


def _textures(house: House) -> HouseTextures | None:
    """The textures of all bodies' faces, in order; None where no mesh has any."""
    meshes = [body.visual for body in house.bodies]
    image = np.full(sum(len(mesh.faces) for mesh in meshes), -1, np.int32)
    uv = np.zeros((len(image), 3, 2), np.float32)
    images, first, start = list[U8](), dict[Path, int](), 0
    for mesh in meshes:
        start += len(mesh.faces)
        if mesh.file is not None and (found := _surface(mesh.file.path)).images:
            if mesh.file.path not in first:
                first[mesh.file.path] = len(images)
                images += found.images
            rows, faces = mesh.file.faces, slice(start - len(mesh.faces), start)
            image[faces] = np.where(found.image[rows] < 0, -1, found.image[rows] + first[mesh.file.path])
            uv[faces] = np.clip(found.uv[rows], -_FARTHEST, _FARTHEST)
    if not images:
        return None
    sizes = np.array([pixels.shape[:2] for pixels in images])
    starts = np.cumsum([0, *sizes.prod(1)])[:-1]
    uv[:, 1:] -= uv[:, :1]
    texels = np.concatenate([pixels.reshape(-1, 3) for pixels in images])
    at = np.vstack([starts, sizes.T]).astype(np.int32)
    return HouseTextures(texels, at, image, uv.transpose(2, 1, 0).reshape(6, -1))


@lru_cache(maxsize=256)
def _surface(path: Path) -> Surface:
    return SurfaceReader(path.resolve().parent).read(path)  # which may be a link


def _pattern(house: House, body: StaticBody, rgb: tuple[int, int, int]) -> tuple[float, ...]:
    if body.object_type in _WOODEN:
        width_m, depth_m, _ = np.ptp(body.visual.vertices_m, axis=0)
        return (*_GRAIN, hash_bytes(body.asset_id)[0], depth_m > width_m)
    name = house.materials.get(rgb, "") if body.kind == "wall" else ""
    found = next((p for word, p in _PATTERNS.items() if word in name.lower()), None)
    seed, turn = hash_bytes(house.digest + name)[:2]
    return _PLAIN if found is None else (*found, seed, turn % 2)

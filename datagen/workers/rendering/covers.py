"""Patterns of the floors, walls and wood of a house in pictures, by the names of its materials."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from datagen.workers.furniture.asset_geometry import SHAPES
from datagen.workers.furniture.solids import hash_bytes
from datagen.workers.geometry.mesh import F32
from datagen.workers.houses.house import House, StaticBody

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
_RANDOM = np.random.default_rng(0).uniform(-1, 1, 256).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Cover:
    """The patterns (10, K) of a house, the first plain, and those of its faces (F,)."""

    patterns: F32
    pattern: I16

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
    return Cover(np.array(list(known), np.float32).T.copy(), np.array(rows, np.int16))


def _pattern(house: House, body: StaticBody, rgb: tuple[int, int, int]) -> tuple[float, ...]:
    if body.object_type in _WOODEN:
        width_m, depth_m, _ = np.ptp(body.visual.vertices_m, axis=0)
        return (*_GRAIN, hash_bytes(body.asset_id)[0], depth_m > width_m)
    name = house.materials.get(rgb, "") if body.kind == "wall" else ""
    found = next((p for word, p in _PATTERNS.items() if word in name.lower()), None)
    seed, turn = hash_bytes(house.digest + name)[:2]
    return _PLAIN if found is None else (*found, seed, turn % 2)

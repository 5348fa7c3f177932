"""Cells of capability maps: of a wrist's distance and height, and of a hand's direction and roll."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F64

Ints = npt.NDArray[np.int64]

DISTANCES, HEIGHTS, SIDES, ROLLS, AZIMUTHS = 16, 32, 3, 8, 12
DIRECTIONS = 6 * SIDES * SIDES  # cells on the faces of a cube
CELLS = DIRECTIONS * ROLLS  # at one distance, height and azimuth


def cells_of(a: F64, c: F64, azimuth: F64 | None) -> Ints:
    """Cells (...) at distance and height 0 of hands with approach a and closing axis c (3, ...).

    As `reach_map.cell_of`; `azimuth` (...) is None for arms that are turned to the front.
    """
    size = np.abs(a)
    face = np.where(size[1] > size[0], 1, 0)
    face = np.where(size[2] > np.maximum(size[0], size[1]), 2, face)

    def part(of: F64, k: Ints) -> F64:
        return np.take_along_axis(of, k[None], axis=0)[0]

    largest = np.where((found := part(size, face)) > 0, found, 1.0)
    sides = [part(a, (face + more) % 3) / largest for more in (1, 2)]
    m, n = (np.minimum(((u + 1) / 2 * SIDES).astype(np.int64), SIDES - 1) for u in sides)
    face = np.where(part(a, face) < 0, face + 3, face)
    # Roll: the angle of c from the horizontal direction across a, or from y where a is steep.
    steep = size[2] > 0.8
    ex, ey = np.where(steep, 0.0, -a[1]), np.where(steep, 1.0, a[0])
    dot = ex * a[0] + ey * a[1]
    x, y, z = ex - dot * a[0], ey - dot * a[1], -dot * a[2]
    px, py, pz = a[1] * z - a[2] * y, a[2] * x - a[0] * z, a[0] * y - a[1] * x
    roll = np.arctan2(c[0] * px + c[1] * py + c[2] * pz, c[0] * x + c[1] * y + c[2] * z)
    r = np.minimum(((roll / (2 * np.pi) + 0.5) * ROLLS).astype(np.int64), ROLLS - 1)
    at = ((face * SIDES + m) * SIDES + n) * ROLLS + r
    if azimuth is None:
        return at
    turn = np.minimum(((azimuth / (2 * np.pi) + 0.5) * AZIMUTHS).astype(np.int64), AZIMUTHS - 1)
    return at * AZIMUTHS + turn

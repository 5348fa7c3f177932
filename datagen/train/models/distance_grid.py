"""Distances to the nearest of some points, in the cells of a box."""

from __future__ import annotations

import numpy as np

from datagen.train.inputs import F32, U8, Array, Bools, Ints

# In cells. The sum of two squares fits in a byte.
FARTHEST = 11


class DistanceGrid:
    """Distances (m) from cells to the nearest cell with a point, at most `FARTHEST` cells."""

    def __init__(self, points_m: Array, low_m: Array, shape: tuple[int, int, int], cell_m: float) -> None:
        """Points (M, 3) outside the box of `shape` cells with its corner at `low_m` (3,) are left out."""
        self._low_m, self._shape, self._cell_m = low_m, shape, cell_m
        cell, inside = self._cells(points_m[np.isfinite(points_m).all(1)])
        square = np.full(shape, FARTHEST**2, np.uint8)
        square[tuple(cell[inside].T)] = 0
        for axis in range(3):
            square = _nearer(square, axis)
        self._distance_m: F32 = np.sqrt(square.ravel(), dtype=np.float32) * np.float32(cell_m)

    def __call__(self, points_m: Array, outside_m: float) -> F32:
        """Distances (...) of points (..., 3); `outside_m` for those outside of the box."""
        cell, inside = self._cells(points_m)
        row = (cell[..., 0] * self._shape[1] + cell[..., 1]) * self._shape[2] + cell[..., 2]
        return np.where(inside, self._distance_m[np.where(inside, row, 0)], np.float32(outside_m))

    def _cells(self, points_m: Array) -> tuple[Ints, Bools]:
        cell = np.floor((points_m - self._low_m) / self._cell_m).astype(np.int32)
        return cell, np.asarray(((cell >= 0) & (cell < self._shape)).all(-1), np.bool_)


def _nearer(square: U8, axis: int) -> U8:
    """The least of a cell's squared distance and those of the cells along `axis`, plus their own squared.

    After all three axes it is the squared distance in space (Felzenszwalb and Huttenlocher 2012, without
    their envelope: few steps along a line of bytes cost less).
    """
    line, found = np.moveaxis(square, axis, 0), square.copy()
    out = np.moveaxis(found, axis, 0)
    for step in range(1, min(FARTHEST, len(line))):
        further = line + np.uint8(step * step)
        np.minimum(out[step:], further[:-step], out=out[step:])
        np.minimum(out[:-step], further[step:], out=out[:-step])
    return found

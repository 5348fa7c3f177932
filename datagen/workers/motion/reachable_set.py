"""Where a robot's hand gets at all, seen from its base: by height, distance, and direction from the base.

The reachability map of Zacharias, Borst and Hirzinger 2007, "Capturing robot workspace structure", on a
cylinder around the mount; `reachable_set_of` computes it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.kinematics.tree import Bools

Bits = npt.NDArray[np.uint64]

# Parts of the sphere of approach directions, all of one area: by their z, and by their azimuth.
LEVELS, AZIMUTHS = 8, 16
SECTORS = 64  # of azimuth around the base: the bits of a number
_ONE, _ALL = np.uint64(1), np.uint64(2**SECTORS - 1)


@dataclass(frozen=True, eq=False)
class ReachableSet:
    """Poses of the TCP within the limits of the joints, whether or not links collide there.

    Base frame: the mount, z up, x to the front. Cells are rings of `cell_m` around its z axis by distance,
    and layers of `cell_m` by height from `lowest_m` on. Bit s of a number stands for positions at azimuths
    from s / 64 of a turn on, counter-clockwise from x. Directions of approach are those of `part_directions`,
    where azimuth 0 points away from the mount.
    """

    sectors: Bits  # (D, H, LEVELS, AZIMUTHS)
    cell_m: float
    lowest_m: float

    @cached_property
    def inside(self) -> Bits:
        """Sectors (D, H) reached in any direction. Gaps of one cell, which samples leave, are filled."""
        found = np.bitwise_or.reduce(self.sectors.reshape(*self.sectors.shape[:2], -1), axis=2)
        return found | ~_spread(~_spread(found))

    @cached_property
    def near(self) -> Bits:
        """Sectors (D, H) that are inside, or next to one that is."""
        return _spread(self.inside)

    @property
    def farthest_m(self) -> float:
        """Horizontal distance from the mount beyond which no position is reached."""
        return self.cell_m * float(np.flatnonzero(self.near.any(axis=1)).max(initial=-1) + 1)

    def holds(self, positions_base_m: F64, or_next: bool = False) -> Bools:
        """Whether the TCP gets to the cells of positions (N, 3), base frame, or to one next to them.

        Without `or_next` a position at the border that is reached may be missing.
        """
        x, y, z = positions_base_m.T
        cells = self.near if or_next else self.inside
        ring = np.floor(np.hypot(x, y) / self.cell_m).astype(np.int64)
        layer = np.floor((z - self.lowest_m) / self.cell_m).astype(np.int64)
        is_there = (ring < cells.shape[0]) & (layer >= 0) & (layer < cells.shape[1])
        bits = cells[np.where(is_there, ring, 0), np.where(is_there, layer, 0)]
        sector = np.floor(np.arctan2(y, x) / (2 * np.pi) * SECTORS).astype(np.int64) % SECTORS
        return is_there & ((bits >> sector.astype(np.uint64)) & _ONE).astype(np.bool_)

    def directions_at(self, azimuth_rad: float) -> F32:
        """Whether (D, H, LEVELS, AZIMUTHS) the TCP gets to each ring and layer there: 0 or 1."""
        sector = int(np.floor(azimuth_rad / (2 * np.pi) * SECTORS)) % SECTORS
        return ((self.sectors >> np.uint64(sector)) & _ONE).astype(np.float32)


def _spread(bits: Bits) -> Bits:
    """Sectors (D, H) of the cells and of those next to them. The innermost ring has no direction."""
    by = np.uint64(SECTORS - 1)
    found = bits | (bits << _ONE) | (bits >> by) | (bits >> _ONE) | (bits << by)
    found[0] = np.where(found[0] > 0, _ALL, found[0])
    for axis in (0, 1):
        lower, upper = np.zeros_like(found), np.zeros_like(found)
        rows = np.swapaxes(found, 0, axis)
        np.swapaxes(lower, 0, axis)[1:], np.swapaxes(upper, 0, axis)[:-1] = rows[:-1], rows[1:]
        found = found | lower | upper
    return found


def direction_parts(directions: F64, ahead_rad: F64 | float = 0.0) -> tuple[F64, F64]:
    """Parts (N,) of unit vectors (N, 3), by level and azimuth, counted from the azimuth `ahead_rad`.

    Whole numbers are the parts' lower edges.
    """
    azimuth = (np.arctan2(directions[:, 1], directions[:, 0]) - ahead_rad) / (2 * np.pi) % 1
    return (directions[:, 2] + 1) / 2 * LEVELS, azimuth * AZIMUTHS


def part_directions() -> F64:
    """Unit vectors (LEVELS, AZIMUTHS, 3) in the middle of each part."""
    z = (np.arange(LEVELS) + 0.5) / LEVELS * 2 - 1
    azimuth = (np.arange(AZIMUTHS) + 0.5) / AZIMUTHS * 2 * np.pi
    flat = np.sqrt(1 - z**2)[:, None]
    x, y = flat * np.cos(azimuth), flat * np.sin(azimuth)
    return np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], axis=2)

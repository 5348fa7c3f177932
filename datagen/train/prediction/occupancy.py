"""What maps of a floor say about the places where a base may stand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datagen.train.inputs import F64
from datagen.workers.occupancy_map import FREE, OCCUPIED, UNKNOWN, OccupancyMap

# Cells are taken as points this far apart or nearer, each as several.
_STEP_M = 0.02


@dataclass(frozen=True, eq=False)
class KnownFloor:
    """What maps say about a floor, of several the first that knows it, and where no base may stand."""

    maps: tuple[OccupancyMap, ...] = ()
    keep_out: tuple[OccupancyMap, ...] = ()  # no base may stand on their occupied cells

    def points(self, low_m: F64, high_m: F64) -> tuple[F64, F64]:
        """Positions (N, 2) that are free and (M, 2) that are occupied, between two corners (2,)."""
        if not self.maps and not self.keep_out:
            return np.empty((0, 2)), np.empty((0, 2))
        step_m = min(_STEP_M, *(each.resolution_m / 2 for each in (*self.maps, *self.keep_out)))
        axes = [np.arange(low, high, step_m) + step_m / 2 for low, high in zip(low_m, high_m, strict=True)]
        xy = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        state = np.full(len(xy), UNKNOWN, np.int8)
        for each in self.maps:
            state = np.where(state == UNKNOWN, each.states(xy), state)
        for each in self.keep_out:
            state[each.states(xy) == OCCUPIED] = OCCUPIED
        return xy[state == FREE], xy[state == OCCUPIED]

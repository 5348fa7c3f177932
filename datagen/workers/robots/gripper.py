"""A parallel gripper: the hand of a robot alone, in the frame of its TCP."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datagen.workers.geometry.mesh import F32

Parts = tuple[F32, ...]  # convex parts, each (V, 3)
_Y = np.array([0.0, 1.0, 0.0], np.float32)


@dataclass(frozen=True, eq=False)
class Gripper:
    """A parallel gripper in its TCP frame.

    The origin lies between the pads' centres, z is the direction of approach, out of the palm, and
    the fingers close along y. Finger 0 is on the side of +y, finger 1 on that of -y; both move by
    half the opening.
    """

    name: str
    digest: str  # of all other fields; a key of caches
    max_opening_m: float
    pad_size_m: tuple[float, float]  # of the rubber that touches: along x and along z
    palm_depth_m: float  # from the TCP back to the palm's surface, along -z
    palm_parts_m: Parts  # TCP frame
    finger_parts_m: tuple[Parts, Parts]  # TCP frame, fingers closed (opening 0)

    def parts_at(self, opening_m: float) -> Parts:
        """All convex parts of the hand, TCP frame, with the pads `opening_m` apart."""
        shift: F32 = (_Y * (opening_m / 2)).astype(np.float32)
        left, right = self.finger_parts_m
        return (*self.palm_parts_m, *(p + shift for p in left), *(p - shift for p in right))

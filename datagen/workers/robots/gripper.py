"""Grippers: a palm and fingers that open and close, as convex parts in the frame of the TCP."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from datagen.workers.geometry.mesh import F32, F64, transformed
from datagen.workers.kinematics.tree import Ints, KinematicTree, frame_poses

Parts = tuple[F32, ...]  # convex parts, each (V, 3)
_Y = np.array([0.0, 1.0, 0.0], np.float32)
_GIVE_M = 0.01


@dataclass(frozen=True, eq=False)
class Linkage:
    """Fingers that turn: B bodies, the palm first, and where each stands at an opening.

    The map from openings to the coordinate was measured at K openings; between them it is linear.
    """

    tree: KinematicTree  # of one coordinate; frames: the bodies and the TCP, each at the closed hand's TCP
    parts_m: tuple[Parts, ...]  # (B,), TCP frame, hand closed
    side: Ints  # (B,), 1 and -1 for fingers on the sides of +y and -y, 0 for the palm
    opening_m: F64  # (K,), increasing: the first is the closed hand
    coordinate: F64  # (K,)
    depth_m: F64  # (K,), z of the pads' middle


@dataclass(frozen=True, eq=False)
class Gripper:
    """A gripper in its TCP frame.

    The origin lies between the pads' centres of the closed hand, z is the direction of approach, out of the
    palm, and the fingers close along y. Fingers 0 are on the side of +y, fingers 1 on that of -y. Without a
    linkage they are one body a side that slides by half the opening.
    """

    name: str
    digest: str  # digest of all other fields; a key of caches
    max_opening_m: float
    pad_size_m: tuple[float, float]  # rubber that touches: along x and along z
    palm_depth_m: float  # from the TCP back to the palm's surface, along -z
    palm_parts_m: Parts  # TCP frame
    finger_parts_m: tuple[Parts, Parts]  # TCP frame, fingers closed (opening 0)
    linkage: Linkage | None = None

    @property
    def least_width_m(self) -> float:
        """Width of the thinnest object between the pads: these give, or lack their rubber in the URDF."""
        return 0.0 if self.linkage is None else max(float(self.linkage.opening_m[0]) - _GIVE_M, 0.0)

    def body_poses(self, opening_m: F64) -> F64:
        """Poses (M, B, 4, 4) of the bodies in the TCP frame with the pads `opening_m` (M,) apart."""
        if self.linkage is None:
            T = np.tile(np.eye(4), (len(opening_m), 3, 1, 1))
            T[:, 1, 1, 3], T[:, 2, 1, 3] = opening_m / 2, -opening_m / 2
            return T
        known = self.linkage
        q = np.interp(opening_m, known.opening_m, known.coordinate)
        return frame_poses(known.tree, q[:, None])[:, :-1]

    def pad_depth_m(self, opening_m: F64) -> F64:
        """z (M,) of the pads' middle in the TCP frame at openings (M,): fingers that turn move it."""
        if self.linkage is None:
            return np.zeros_like(opening_m)
        return np.interp(opening_m, self.linkage.opening_m, self.linkage.depth_m)

    def parts_at(self, opening_m: float) -> Parts:
        """All convex parts of the hand, TCP frame, with the pads `opening_m` apart."""
        shift: F32 = (_Y * (opening_m / 2)).astype(np.float32)
        left, right = self.fingers_near(opening_m)
        return (*self.palm_parts_m, *(p + shift for p in left), *(p - shift for p in right))

    def posture(self, opening_m: F64) -> Ints:
        """Row (M,) of the nearest measured opening, for `fingers_in`; 0 for sliding fingers."""
        if self.linkage is None:
            return np.zeros(len(opening_m), np.int64)
        return np.abs(np.asarray(opening_m)[:, None] - self.linkage.opening_m).argmin(axis=1)

    def fingers_near(self, opening_m: float) -> tuple[Parts, Parts]:
        """The two fingers as bodies that slide along y around an opening: TCP frame, slid to opening 0.

        A finger that turns is taken as rigid around the nearest measured opening, where it is exact.
        """
        return self.fingers_in[int(self.posture(np.array([opening_m]))[0])]

    @cached_property
    def fingers_in(self) -> tuple[tuple[Parts, Parts], ...]:
        """`fingers_near` each measured opening (K,)."""
        if self.linkage is None:
            return (self.finger_parts_m,)
        known = self.linkage
        T = self.body_poses(known.opening_m)

        def fingers(k: int, side: int) -> Parts:
            shift = side * known.opening_m[k] / 2 * _Y
            return tuple(
                (transformed(part, T[k, b]) - shift).astype(np.float32)
                for b in np.flatnonzero(known.side == side)
                for part in known.parts_m[b]
            )

        return tuple((fingers(k, 1), fingers(k, -1)) for k in range(len(known.opening_m)))

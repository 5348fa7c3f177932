"""Poses of a hand around pairs of contacts: directions of approach, depths, tilts, diverse selection."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F64
from datagen.workers.grasps.contacts import Contacts, perpendicular

# How far the contacts lie ahead of the pads' middle, in half pad lengths. Pulled back, the finger tips do not
# reach below flat objects. Beyond 1 the pads would miss the contacts.
RETREATS = (-0.5, 0.0, 0.5, 0.8, 0.95)
# From straight down, about the axis along which the fingers close.
TILTS_RAD = (0.0, np.radians(15), np.radians(-15), np.radians(30), np.radians(-30))
# Grasps from above need a closing axis no steeper than this.
_LEVEL_Z = np.sin(np.radians(35))
_FREE_TURNS = 4  # approaches all around the closing axis, besides those from above
# A radian between two directions weighs as much as this distance.
_METRES_PER_RAD = 0.03


def hand_poses(contacts: Contacts, pad_length_m: float, rng: np.random.Generator) -> tuple[F64, F64]:
    """Poses T_object_tcp (K, 4, 4) of every pair, approach and depth in random order; widths (K,), metres.

    Approaches are drawn all around the closing axis and, where it is level enough for the upright object,
    from above with `TILTS_RAD`. The contacts lie on pads of `pad_length_m` along the approach, at the same
    distance left and right of the hand's middle, at one of `RETREATS`.
    """
    n = len(contacts)
    y = contacts.closing * np.where(rng.random(n) < 0.5, 1.0, -1.0)[:, None]
    u, v = perpendicular(y)
    turns = 2 * np.pi * rng.random((n, _FREE_TURNS))
    around = np.cos(turns)[..., None] * u[:, None] + np.sin(turns)[..., None] * v[:, None]
    level = np.abs(y[:, 2]) < _LEVEL_Z
    down = -np.array([0.0, 0.0, 1.0]) + y[level, 2:] * y[level]
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    across = np.cross(y[level], down)
    tilts = np.array(TILTS_RAD)
    above = np.cos(tilts)[:, None] * down[:, None] + np.sin(tilts)[:, None] * across[:, None]
    row = np.concatenate(
        [np.repeat(np.arange(n), _FREE_TURNS), np.repeat(np.flatnonzero(level), len(TILTS_RAD))]
    )
    approach = np.concatenate([around.reshape(-1, 3), above.reshape(-1, 3)])
    row = np.repeat(row, len(RETREATS))
    approach = np.repeat(approach, len(RETREATS), axis=0)
    retreat = pad_length_m / 2 * np.resize(RETREATS, len(row))
    order = rng.permutation(len(row))
    row, approach, retreat = row[order], approach[order], retreat[order]
    middle = (contacts.first_m + contacts.second_m) / 2
    T = np.zeros((len(row), 4, 4))
    T[:, :3, 0] = np.cross(y[row], approach)
    T[:, :3, 1] = y[row]
    T[:, :3, 2] = approach
    T[:, :3, 3] = middle[row] - retreat[:, None] * approach
    T[:, 3, 3] = 1
    return T, contacts.width_m[row]


def varied(T_object_tcp: F64, n: int) -> npt.NDArray[np.int64]:
    """Rows of at most n poses by farthest-point sampling, from the first pose on.

    The distance adds those of positions and of directions of approach and closing; a grasp and its flip
    count as one (Gonzalez 1985, Theor. Comput. Sci. 38).
    """
    if len(T_object_tcp) == 0 or n < 1:
        return np.zeros(0, np.int64)
    y, z = T_object_tcp[:, :3, 1], T_object_tcp[:, :3, 2]
    position = np.ascontiguousarray(T_object_tcp[:, :3, 3].T)  # (3, N): sums over a long last axis are fast
    gap = np.full(len(y), np.inf)
    rows = [0]
    while len(rows) < min(n, len(y)):
        k = rows[-1]
        apart = np.sqrt(np.square(position - position[:, k : k + 1]).sum(axis=0))
        turned = np.arccos(np.clip(z @ z[k], -1, 1)) + np.arccos(np.clip(np.abs(y @ y[k]), 0, 1))
        gap = np.minimum(gap, apart + _METRES_PER_RAD * turned)
        gap[k] = -1.0
        rows.append(int(gap.argmax()))
    return np.array(rows)

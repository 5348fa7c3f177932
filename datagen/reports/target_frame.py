"""Positions on the floor relative to the target and to the nearest edge of the surface that carries it."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]

# The side of the target on which a base stands, by the angle from the nearest edge's direction (degrees).
SIDES = ("nearest edge", "left", "right", "far side")


def towards_nearest_edge(T_world_support: F64, support_size_m: F64, target_center_m: F64) -> F64:
    """Directions (S, 2), unit vectors in the world, from the target across the nearest edge of its support.

    `T_world_support` (S, 4, 4), `support_size_m` (S, 2) and `target_center_m` (S, 3) are stored with scenes.
    """
    axes = T_world_support[:, :2, :2]  # columns: the support's x and y in the world; its z is up
    offset = np.einsum("sij,si->sj", axes, target_center_m[:, :2] - T_world_support[:, :2, 3])
    gaps = np.concatenate(
        [support_size_m / 2 - offset, support_size_m / 2 + offset], axis=1
    )  # +x, +y, -x, -y
    outward = np.concatenate([axes, -axes], axis=2)  # (S, 2, 4)
    return np.take_along_axis(outward, gaps.argmin(axis=1)[:, None, None], axis=2)[:, :, 0]


def in_edge_frame(base_xy_m: npt.NDArray[Any], target_xy_m: F64, towards_edge: F64) -> F64:
    """Positions (N, 2) with the origin at the target and the nearest edge of its support towards -y.

    All arguments are (N, 2) in the world. The result is in metres, x to the right as seen from above.
    """
    back = -towards_edge
    right = np.stack([back[:, 1], -back[:, 0]], axis=1)
    offset = base_xy_m.astype(np.float64) - target_xy_m
    return np.stack([(offset * right).sum(axis=1), (offset * back).sum(axis=1)], axis=1)


def side_of(xy_m: F64) -> npt.NDArray[np.intp]:
    """Index (N,) into SIDES of positions (N, 2) in the edge frame: quarters, 45 degrees to either side."""
    x, y = xy_m.T
    across = np.abs(y) >= np.abs(x)
    return np.where(across, np.where(y <= 0, 0, 3), np.where(x < 0, 1, 2))

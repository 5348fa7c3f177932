"""Directions from which an open hand reaches the target's centre without touching an observed point."""

from __future__ import annotations

import numpy as np

from datagen.train.baselines.reachability_map import PREGRASP_M
from datagen.train.inputs import F32, F64, Bools
from datagen.workers.robots.description import Gripper

_ROLLS = 4  # in half a turn about the approach: the hand is the same after half a turn
# Stored clouds have a point every 2 to 3 cm: without a margin a finger fits between them.
_ROOM_M = 0.01


def free_approaches(others_m: F32, directions: F64, gripper: Gripper) -> Bools:
    """Mask (...,) of approach directions (..., 3) that are free at some roll of the hand.

    `others_m` (P, 3) are all points but the target's, in the target's frame. The hand's middle goes to its
    origin. Palm and fingers are boxes with a margin, extended backwards over the last way. Unobserved space
    is free.
    """
    boxes = _boxes(gripper)
    far_m = float(np.linalg.norm(np.abs(boxes).max((0, 1))))
    near = others_m[np.linalg.norm(others_m, axis=1) <= far_m]  # also drops points that are not finite
    axes = _rolled(directions.reshape(-1, 3)).astype(np.float32)  # (A, _ROLLS, 3, 3)
    x, y, z = np.moveaxis(near @ axes, -1, 0)  # (A, _ROLLS, P) each
    free: Bools = np.ones(axes.shape[:2], np.bool_)
    for low, high in boxes:
        inside = (z > low[2]) & (z < high[2])
        inside &= (x > low[0]) & (x < high[0])
        inside &= (y > low[1]) & (y < high[1])
        free &= ~inside.any(2)
    return np.asarray(free.any(axis=1)).reshape(directions.shape[:-1])


def _boxes(gripper: Gripper) -> F64:
    """(3, 2, 3): lowest and highest corners of the palm and the fingers in the TCP frame."""
    n = len(gripper.palm_parts_m)
    parts = gripper.parts_at(gripper.max_opening_m)
    fingers = len(gripper.finger_parts_m[0])
    groups = (parts[:n], parts[n : n + fingers], parts[n + fingers :])
    corners = [np.concatenate(group) for group in groups]
    boxes = np.array([[c.min(0) - _ROOM_M, c.max(0) + _ROOM_M] for c in corners], np.float64)
    boxes[:, 0, 2] -= PREGRASP_M
    return boxes


def _rolled(z: F64) -> F64:
    """Axes (A, _ROLLS, 3, 3), as columns, of hands that approach along unit vectors (A, 3)."""
    aside: F64 = np.cross(z, np.eye(3)[np.abs(z).argmin(1)])
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    up: F64 = np.cross(z, aside)
    angle = (np.pi * np.arange(_ROLLS) / _ROLLS)[:, None]
    x: F64 = np.cos(angle) * aside[:, None] + np.sin(angle) * up[:, None]
    along = np.broadcast_to(z[:, None], x.shape)
    y: F64 = np.cross(along, x)
    return np.stack([x, y, along], axis=3)

"""Machines of few joints among boxes: their paths can be judged by eye."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.transforms import translation
from datagen.workers.kinematics.compiler import in_memory
from datagen.workers.kinematics.contacts import parts_of
from datagen.workers.kinematics.tree import KinematicTree
from datagen.workers.motion.arm_motion import Arm, Search, search_at
from datagen.workers.motion.hand_motion import Hand, Limits, Room
from datagen.workers.motion.planning_scene import limits_of, still_of
from datagen.workers.motion.reach_map import ReachMap
from tests.workers.motion.tables import PARAMS
from tests.workers.worlds import box_vertices

LIMITS = limits_of(PARAMS)._replace(margin_m=0.0)
CUBE_M = 0.02
ABOVE = translation(0.0, 0.0, 0.1)


def machine(
    boxes: Sequence[F32],
    kinds: Sequence[int] = (),
    limits: Limits = LIMITS,
    homes: Sequence[F64] = (),
    axes: F64 | None = None,
    slides: Sequence[bool] = (True, True, True),
    T_hand: F64 = ABOVE,
) -> Search:
    """A small cube on joints that slide or turn; its hand is a cube above it, larger when open."""
    tree = KinematicTree(
        np.arange(3) - 1, np.tile(np.eye(4), (3, 1, 1)), np.eye(3) if axes is None else axes,
        np.array(slides), np.arange(3), np.ones(3), np.zeros(3), np.full(3, -1.0), np.full(3, 1.0),
        np.array([2, 2]), np.stack([np.eye(4), T_hand]),
    )  # fmt: skip
    cube, none = box_vertices((CUBE_M,) * 3), parts_of([])
    count = np.zeros(2, np.int32)
    reach = ReachMap(count, np.zeros((0, 3), np.float32), np.zeros(2), -1, np.zeros(3), 1.0, count)
    rows = np.array(homes, np.float64).reshape(-1, 3)
    arm = Arm(
        tree.along_z(), parts_of([[cube]]), none, none, np.zeros((0, 2), np.int64), rows, np.ones(3), reach
    )
    still = still_of(list(boxes), list(kinds) or [0] * len(boxes))
    room = in_memory(Room(still, np.arange(len(boxes))))
    small, large = parts_of([[cube]]), parts_of([[2 * cube]])
    pair = {
        k: np.concatenate([getattr(p, k) for p in (small, large)]) for k in ("points_m", "center_m", "half_m")
    }
    hand = in_memory(Hand(small._replace(**pair), small))
    lines, root = np.empty((5, 5, 3)), np.ascontiguousarray(np.eye(4)[:3])
    within = np.arange(len(boxes))
    return search_at(
        in_memory(arm),
        hand,
        room,
        in_memory(limits),
        root,
        within,
        lines,
        lines.copy(),
        np.zeros(1, np.int64),
    )

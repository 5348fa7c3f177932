"""Settled scenes made by hand, and plans for them by inverse kinematics along straight lines."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import inverse, translation, yaw_pose
from datagen.workers.houses.house import StaticBody
from datagen.workers.motion import MotionPlan
from datagen.workers.objects.model import ObjectModel
from datagen.workers.robots.robot import Robot
from datagen.workers.scenes import SettledScene
from tests.workers.motion.tables import scene_of
from tests.workers.worlds import ROOM_M, TABLE_TOP_M, on_table, table_house

PREGRASP_M, LIFT_M = 0.08, 0.10
# The fingers come from above, closing along the world's y.
DOWN = np.diag([1.0, -1.0, -1.0, 1.0])


def scene_with(
    models: Sequence[ObjectModel],
    offsets_m: Sequence[tuple[float, float]],
    furniture: Sequence[StaticBody] = (),
) -> SettledScene:
    """Objects upright on the table, each off its middle by its (dx, dy)."""
    poses = [on_table(m, dx, dy) for m, (dx, dy) in zip(models, offsets_m, strict=True)]
    return scene_of(table_house(furniture), models, poses)


def base_before(robot: Robot, distance_m: float) -> F64:
    """The mount (4, 4) on the table's -x side, facing its middle from so far away."""
    return yaw_pose(ROOM_M[0] / 2 - distance_m, ROOM_M[1] / 2, robot.base_height_m, 0.0)


def plan_from_above(robot: Robot, T_world_base: F64, grasp_m: F64, opening_m: float) -> MotionPlan:
    """A plan that grasps at a world position (3,) from above."""
    T_grasp = inverse(T_world_base) @ translation(*grasp_m) @ DOWN
    homes, low, high = robot.homes_rad, robot.q_lower_rad, robot.q_upper_rad
    others = np.random.default_rng(0).uniform(low, high, (40, len(low)))
    for k, seed in enumerate([*homes, *others]):
        k = k % len(homes)
        home, q_grasp = homes[k], robot.ik(T_grasp, seed)
        if q_grasp is None:
            continue
        down, up = (
            _line(robot, q_grasp, [translation(0, 0, z) @ T_grasp for z in np.linspace(0, length_m, 10)])
            for length_m in (PREGRASP_M, LIFT_M)
        )
        if down is None or up is None:
            continue
        approach = down[::-1]
        reach = np.stack([home, approach[0]])
        way = np.concatenate([reach, approach[1:]])
        length_rad = float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
        return MotionPlan(0, k, reach, approach, up, opening_m, length_rad, 0.05, 1.0)
    raise AssertionError("no such grasp: choose a base that reaches it")


def _line(robot: Robot, q_start: F64, poses: Sequence[F64]) -> F64 | None:
    rows = [q_start]
    for T in poses[1:]:
        q = robot.ik(T, rows[-1])
        if q is None or np.abs(q - rows[-1]).max() > 0.6:
            return None
        rows.append(q)
    return np.stack(rows)


def on_top_m(scene: SettledScene, depth_m: float) -> F64:
    """The point (3,) so far below the target's top, over its middle."""
    x, y, _ = scene.target_center_m
    return np.array([x, y, TABLE_TOP_M + scene.models[0].size_m[2] - depth_m])

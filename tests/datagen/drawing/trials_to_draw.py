"""A hand-made scene with a real robot and a hand-made recording of it, to be drawn."""

from __future__ import annotations

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import inverse, yaw_pose
from datagen.workers.houses.house import House
from datagen.workers.rendering.embree import ray_scene
from datagen.workers.robots import open_robot
from datagen.workers.robots.robot import Robot
from datagen.workers.scenes.reconstruct import ReconstructedScene
from datagen.workers.trials import Recording
from datagen.workers.world import PreparedHouse
from tests.workers.worlds import ROOM_M, TABLE_TOP_M, box_model, camera_at, stage_with

_PHASES = (("reach", 12), ("approach", 6), ("close", 4), ("lift", 6), ("hold", 3))


def recalled(house: House | None = None) -> ReconstructedScene:
    """A tall box in the middle of the table, a low one beside it."""
    models = (
        box_model("target", (0.05, 0.05, 0.16)),
        box_model("clutter", (0.06, 0.06, 0.05), rgb=(40, 90, 200)),
    )
    stage = stage_with(models, ((0.0, 0.0), (0.25, 0.15)), house)
    camera = camera_at((0.4, 0.4, 1.4), (ROOM_M[0] / 2, ROOM_M[1] / 2, TABLE_TOP_M))
    return ReconstructedScene(
        0, 0, PreparedHouse(stage.house), models, stage.T_world_object, ray_scene(stage), camera
    )


def robot() -> Robot:
    """A small arm on a pedestal of the table's height."""
    return open_robot("panda-scaled", 0.8, TABLE_TOP_M)


def base_pose(side_m: float = 0.62) -> F64:
    """In front of the table's long side, turned to its middle."""
    return yaw_pose(ROOM_M[0] / 2, ROOM_M[1] / 2 - side_m, TABLE_TOP_M, np.pi / 2)


def recording_of(arm: Robot, scene: ReconstructedScene, T_world_base: F64) -> Recording:
    """The hand comes from above and lifts the target by 10 cm."""
    T_grasp = np.diag([1.0, -1.0, -1.0, 1.0])
    T_grasp[:3, 3] = scene.target_center_m + (0, 0, 0.05)
    q = [arm.homes_rad[0]]
    for up_m in (0.1, 0.0, 0.1):
        T = T_grasp.copy()
        T[2, 3] += up_m
        found = (arm.ik(inverse(T_world_base) @ T, seed) for seed in (q[-1], *arm.homes_rad))
        q.append(next(q for q in found if q is not None))
    ends = {"reach": (q[0], q[1]), "approach": (q[1], q[2]), "lift": (q[2], q[3])}
    still = {"close": q[2], "hold": q[3]}
    rows, phases = [], []
    for phase, n in _PHASES:
        start, end = ends.get(phase, (still.get(phase, q[0]),) * 2)
        rows += [start + (end - start) * share for share in np.linspace(0, 1, n)]
        phases += [phase] * n
    poses = np.tile(scene.T_world_object, (len(rows), 1, 1, 1))
    for k, phase in enumerate(phases):
        if phase in ("lift", "hold"):
            height = (T_world_base @ arm.T_base_tcp(rows[k]))[2, 3] - T_grasp[2, 3]
            poses[k, 0, 2, 3] += height
    opening_m = np.where(np.isin(phases, ("reach", "approach")), 0.08, 0.05)
    return Recording(np.arange(len(rows)) / 20, np.array(rows), opening_m, poses, tuple(phases))


def cut(recording: Recording, rows: int) -> Recording:
    """The first rows of a recording, as of a trial that ended early."""
    return Recording(
        recording.time_s[:rows], recording.q_rad[:rows], recording.opening_m[:rows],
        recording.T_world_object[:rows], recording.phase[:rows],
    )  # fmt: skip

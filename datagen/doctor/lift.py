"""The smallest grasp trial: a Panda lifts a cube along straight lines in physics.

    python -m datagen.doctor.lift

The doctor runs it in a separate process. It prints the outcome; exit code 1 unless the trial succeeds.
"""

from __future__ import annotations

import sys

import numpy as np

from datagen.schemas.specification import TrialParams
from datagen.workers.geometry.mesh import F32, F64
from datagen.workers.geometry.transforms import translation
from datagen.workers.motion import MotionPlan
from datagen.workers.robots import open_robot
from datagen.workers.robots.robot import Robot
from datagen.workers.trials import Disturbance
from datagen.workers.trials.execute import run_trial
from datagen.workers.trials.trial_scene import TrialScene, articulation_of

_BASE_HEIGHT_M, _TABLE_M = 0.5, 0.5
_CUBE_M, _MASS_KG = 0.05, 0.2
_AHEAD_M = 0.5
_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])
_PREGRASP_M, _LIFT_M = 0.08, 0.10


def main() -> int:
    """Run the trial, print its outcome and return the exit code."""
    robot = open_robot("panda", None, _BASE_HEIGHT_M)
    cube = _block(0.0, _CUBE_M, _CUBE_M, -_CUBE_M / 2, _CUBE_M / 2)
    table = _block(_AHEAD_M + 0.1, 0.4, 0.8, 0.0, _TABLE_M)
    prepared = TrialScene(
        robot=robot,
        articulation=articulation_of(robot),
        params=TrialParams(),
        base_radius_m=0.1,
        still_parts_m=(table,),
        still_low_m=table.min(axis=0, keepdims=True).astype(np.float64),
        still_high_m=table.max(axis=0, keepdims=True).astype(np.float64),
        parts_m=((cube,),),
        mass_kg=np.array([_MASS_KG]),
        T_world_object=translation(_AHEAD_M, 0, _TABLE_M + _CUBE_M / 2)[None],
    )
    T_world_base = translation(0, 0, _BASE_HEIGHT_M)
    plan = _plan(robot, translation(_AHEAD_M, 0, _TABLE_M + _CUBE_M / 2 - _BASE_HEIGHT_M) @ _DOWN)
    if plan is None:
        sys.stderr.write("the arm finds no path to a cube in front of it\n")
        return 1
    undisturbed = Disturbance.none(prepared.params.object_friction)
    result = run_trial(prepared, T_world_base, plan, undisturbed)
    if result.outcome != "success":
        sys.stderr.write(f"a trial that should succeed ended as {result.outcome}\n")
        return 1
    sys.stdout.write(f"an arm lifts a cube by {1e3 * result.lift_m:.0f} mm\n")
    return 0


def _block(ahead_m: float, x_m: float, y_m: float, low_m: float, high_m: float) -> F32:
    """Corners (8, 3) of a box around a vertical axis at (`ahead_m`, 0)."""
    x = [ahead_m - x_m / 2, ahead_m + x_m / 2]
    sides = np.meshgrid(x, [-y_m / 2, y_m / 2], [low_m, high_m], indexing="ij")
    return np.stack(sides, axis=-1).reshape(-1, 3).astype(np.float32)


def _plan(robot: Robot, T_base_grasp: F64) -> MotionPlan | None:
    """A plan from a tucked pose to a grasp from above and a lift, by IK along straight lines."""
    for home, q_home in enumerate(robot.homes_rad):
        q_grasp = robot.ik(T_base_grasp, q_home)
        if q_grasp is None:
            continue
        down = _rise(robot, T_base_grasp, q_grasp, _PREGRASP_M)
        up = _rise(robot, T_base_grasp, q_grasp, _LIFT_M)
        if down is not None and up is not None:
            reach = np.stack([q_home, down[-1]])
            return MotionPlan(
                grasp=0,
                home=home,
                q_reach_rad=reach,
                q_approach_rad=down[::-1],
                q_lift_rad=up,
                opening_m=robot.gripper.max_opening_m,
                length_rad=0.0,
                clearance_m=0.0,
                grasp_score=1.0,
            )
    return None


def _rise(robot: Robot, T_base_grasp: F64, q_grasp_rad: F64, height_m: float) -> F64 | None:
    """Joint positions (11, A) from the grasp straight up."""
    rows = [q_grasp_rad]
    for z in np.linspace(0, height_m, 11)[1:]:
        q = robot.ik(translation(0, 0, z) @ T_base_grasp, rows[-1])
        if q is None:
            return None
        rows.append(q)
    return np.stack(rows)


if __name__ == "__main__":
    sys.exit(main())

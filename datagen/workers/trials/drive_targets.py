"""Targets of the drives for each control period, from the tucked pose to the end of holding."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datagen.schemas.specification import TrialParams
from datagen.workers.geometry.mesh import F64
from datagen.workers.motion.motion_plan import MotionPlan
from datagen.workers.robots.robot import Robot
from datagen.workers.trials.time_parameterization import lag_compensated, time_parameterized

PHASES = ("reach", "approach", "close", "lift", "hold")
# Share of the joints' speed limits at which the arm moves, as is usual near people and objects.
SPEED_SHARE = 0.5
_ARRIVE_S = 0.1  # for the drives to catch up before the next phase
_CLOSING_SHARE = 0.8  # of close_s, in which the fingers' targets travel; then they press
# Newtons per metre and newton seconds per metre of a finger's drive. Stiff, so that an object's weight
# along the closing axis moves it by a millimetre or two against the hand.
FINGER_STIFFNESS, FINGER_DAMPING = 4000.0, 200.0


@dataclass(frozen=True, eq=False)
class ControlPeriod:
    """One control period: the drives' targets at its end, towards which they move evenly."""

    phase: str
    arm_rad: F64  # (A,)
    finger_m: float | None  # of both fingers; None presses with the grip's force
    joints_rad: F64  # (A,) planned at its end
    ends_phase: bool = False


def drive_targets(plan: MotionPlan, robot: Robot, params: TrialParams) -> list[ControlPeriod]:
    """The plan as control periods.

    The reach takes as long as the speed limits require, approach and lift at least `approach_s` and `lift_s`.
    Targets are ahead of the path by the drives' lag.
    """
    speed, period_s = robot.speed_limit_radps * SPEED_SHARE, params.control_period_s
    lag_s = robot.damping / robot.stiffness
    open_m = plan.opening_m / 2

    def move(
        phase: str, path_rad: F64, at_least_s: float, finger_m: float | None, wait_s: float
    ) -> list[ControlPeriod]:
        joints = time_parameterized(path_rad, speed, period_s, at_least_s)
        targets = lag_compensated(joints, period_s, lag_s)
        rows = list(range(1, len(joints))) + [len(joints) - 1] * _ticks_in(wait_s, period_s)
        last = len(rows) - 1
        return [
            ControlPeriod(phase, targets[k], finger_m, joints[k], at == last) for at, k in enumerate(rows)
        ]

    def stay(phase: str, q_rad: F64, fingers_m: list[float | None]) -> list[ControlPeriod]:
        last = len(fingers_m) - 1
        return [
            ControlPeriod(phase, q_rad, finger_m, q_rad, at == last) for at, finger_m in enumerate(fingers_m)
        ]

    closing = _ticks_in(params.close_s, period_s)
    travelling = max(1, int(closing * _CLOSING_SHARE))
    shut_m = -params.grip_force_n / FINGER_STIFFNESS
    ramp: list[float | None] = (
        open_m + (shut_m - open_m) * np.arange(1, travelling + 1) / travelling
    ).tolist()
    pressing: list[float | None] = [None]
    return [
        *move("reach", plan.q_reach_rad, 0.0, open_m, _ARRIVE_S),
        *move("approach", plan.q_approach_rad, params.approach_s, open_m, _ARRIVE_S),
        *stay("close", plan.q_approach_rad[-1], ramp + pressing * (closing - travelling)),
        *move("lift", plan.q_lift_rad, params.lift_s, None, 0.0),
        *stay("hold", plan.q_lift_rad[-1], pressing * _ticks_in(params.hold_s, period_s)),
    ]


def planned_rise_m(plan: MotionPlan, robot: Robot) -> float:
    """Height in metres by which the plan lifts the hand."""
    grasp, lifted = (robot.T_base_tcp(path[-1]) for path in (plan.q_approach_rad, plan.q_lift_rad))
    return float(lifted[2, 3] - grasp[2, 3])


def pressing_target_m(fingers_m: F64, grip_force_n: float) -> float:
    """Target of both fingers that presses with the grip's force, evenly about the object's middle.

    As in a hand whose fingers are coupled, a push along the closing axis moves one finger back and the
    other after it. `fingers_m` (2,) are their positions.
    """
    return float(np.mean(fingers_m)) - grip_force_n / FINGER_STIFFNESS


def _ticks_in(seconds: float, period_s: float) -> int:
    return max(1, round(seconds / period_s)) if seconds > 0 else 0

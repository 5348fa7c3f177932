"""Joint paths in time, and the targets of the drives in each control period."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datagen.schemas.specification import TrialParams
from datagen.workers.geometry.mesh import F64
from datagen.workers.motion import MotionPlan
from datagen.workers.robots.robot import Robot

PHASES = ("reach", "approach", "close", "lift", "hold")
# Share of the joints' speed limits at which the arm moves, as is usual near people and objects.
SPEED_SHARE = 0.5
_ARRIVE_S = 0.1  # for the drives to catch up before the next phase
_CLOSING_SHARE = 0.8  # share of close_s in which the fingers' targets travel; then they press
# Newtons per metre and newton seconds per metre of a finger's drive. Stiff, so that an object's weight
# along the closing axis moves it by a millimetre or two against the hand.
FINGER_STIFFNESS, FINGER_DAMPING = 4000.0, 200.0


@dataclass(frozen=True, eq=False)
class ControlPeriod:
    """One control period: the drives' targets at its end, towards which they move evenly."""

    phase: str
    arm_rad: F64  # (A,)
    finger_m: float | None  # both fingers; None presses with the grip's force
    joints_rad: F64  # (A,) planned at its end
    ends_phase: bool = False


def drive_targets(plan: MotionPlan, robot: Robot, params: TrialParams) -> list[ControlPeriod]:
    """The plan as control periods.

    The reach takes as long as the speed limits require, approach and lift at least `approach_s` and `lift_s`.
    Targets are ahead of the path by the drives' lag.
    """
    speed, period_s = robot.speed_limit_radps * SPEED_SHARE, params.control_period_s
    lag_s = robot.drive.damping / robot.drive.stiffness
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


# Time from rest to full speed. A joint's speed may jump by its gain in a control period.
SPEED_UP_S = 0.25
_GRID_RAD = 0.02  # spacing of the points at which speeds are decided
_SAME_RAD = 1e-9


def time_parameterized(path_rad: F64, speed_radps: F64, period_s: float, at_least_s: float) -> F64:
    """Joints (N, A) every `period_s` along a path of straight lines (M, A), from rest to rest.

    The fastest motion in which no joint exceeds its speed (A,), gains more than it in `SPEED_UP_S`,
    or jumps in speed at a corner by more than it gains in a period; then slowed down to `at_least_s`
    and to whole periods. Speeds are decided forwards and backwards over a grid, as in numerical path
    parameterisation (Bobrow, Dubowsky, Gibson 1985).
    """
    steps = np.diff(path_rad, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    kept = lengths > _SAME_RAD
    steps, lengths = steps[kept], lengths[kept]
    if len(steps) == 0:
        ticks = max(1, int(np.ceil(at_least_s / period_s - 1e-9)))
        joints = np.repeat(path_rad[:1], ticks + 1, axis=0)
        joints[-1] = path_rad[-1]
        return joints
    corners = np.vstack([path_rad[:1], path_rad[1:][kept]])
    directions = steps / lengths[:, None]
    acceleration = speed_radps / SPEED_UP_S
    fastest = (speed_radps / np.maximum(np.abs(directions), 1e-12)).min(axis=1)  # (S,) along each line
    gain = (acceleration / np.maximum(np.abs(directions), 1e-12)).min(axis=1)
    turns = np.abs(np.diff(directions, axis=0))  # (S - 1, A)
    at_corner = (acceleration * period_s / np.maximum(turns, 1e-12)).min(axis=1)

    cells = np.maximum(1, np.ceil(lengths / _GRID_RAD).astype(int))
    if cells.sum() == 1:
        cells += 1  # at rest at both ends: there must be a point between them that moves
    line = np.repeat(np.arange(len(lengths)), cells)  # line of each grid cell
    ds = np.repeat(lengths / cells, cells)
    s = np.concatenate([[0.0], np.cumsum(ds)])
    v2 = np.concatenate([[0.0], np.minimum(fastest[line[:-1]], fastest[line[1:]]) ** 2, [0.0]])
    ends = np.cumsum(cells)[:-1]
    v2[ends] = np.minimum(v2[ends], at_corner**2)
    gained = 2 * gain[line] * ds
    for k in range(len(ds)):
        v2[k + 1] = min(v2[k + 1], v2[k] + gained[k])
    for k in range(len(ds) - 1, -1, -1):
        v2[k] = min(v2[k], v2[k + 1] + gained[k])
    v = np.sqrt(v2)
    dt = 2 * ds / (v[:-1] + v[1:])
    t = np.concatenate([[0.0], np.cumsum(dt)])

    ticks = max(1, int(np.ceil(max(t[-1], at_least_s) / period_s - 1e-9)))
    moments = np.linspace(0.0, t[-1], ticks + 1)
    cell = np.clip(np.searchsorted(t, moments, side="right") - 1, 0, len(ds) - 1)
    tau = moments - t[cell]
    along = s[cell] + v[cell] * tau + (v[cell + 1] - v[cell]) / dt[cell] * tau**2 / 2
    starts = np.concatenate([[0.0], np.cumsum(lengths)])
    on = np.clip(np.searchsorted(starts, along, side="right") - 1, 0, len(lengths) - 1)
    share = np.clip((along - starts[on]) / lengths[on], 0.0, 1.0)[:, None]
    joints = corners[on] * (1 - share) + corners[on + 1] * share
    joints[0], joints[-1] = path_rad[0], path_rad[-1]
    return joints


def lag_compensated(joints_rad: F64, period_s: float, lag_s: float) -> F64:
    """Targets (N, A) for spring-damper drives, which follow a moving target late by damping / stiffness.

    Each target is ahead by this lag, so that the joints follow `joints_rad` (N, A).
    """
    speed = np.zeros_like(joints_rad)
    speed[1:-1] = (joints_rad[2:] - joints_rad[:-2]) / (2 * period_s)
    return joints_rad + lag_s * speed

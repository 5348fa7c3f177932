"""One planned grasp executed in physics: reach, approach, close, lift, hold, and how it ended."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from workers.geometry.mesh import F64
from workers.geometry.transforms import inverse
from workers.motion.plan import MotionPlan
from workers.trials.physics import FINGER_STIFFNESS, Things, TrialWorld
from workers.trials.prepared import (
    TrialScene,
    moved_target,
    pedestal_below,
    prepare_trials,
    still_parts_near,
)
from workers.trials.schedule import Schedule, led, schedule_of
from workers.trials.trial import Disturbance, Recording, TrialResult

__all__ = ["TrialScene", "prepare_trials", "run_trial"]

# Arrived: no joint farther off than this, nor the TCP, after at most so long.
_JOINT_OFF_RAD, _TCP_OFF_M, _ARRIVE_S = 0.05, 0.015, 0.25
_ARRIVED_RAD = 0.005  # no need to wait any longer
# Farther behind its path than this, the arm is pushing against something.
_BLOCKED_RAD = 0.3
_EMPTY_OPENING_M = 0.001
_LIFTED_SHARE = 0.8  # of the hand's planned rise, for success
_RISEN_SHARE = 0.5  # of it, to speak of dropping rather than slipping
# A finger holds where it pushes with at least this share of the grip's force along the closing axis.
_HOLDS_SHARE = 0.1
_CLOSING_SHARE = 0.8  # of close_s, in which the fingers' targets travel
_LOOK_STEPS = 4  # contacts are looked at after each of the last so many steps of a phase
_SETTLE_S, _SETTLED_MPS = 0.4, 0.02
_SPEED_WITHOUT_SENSE_MPS, _GONE_M = 20.0, 10.0
_LARGEST_M = 100.0


def run_trial(
    prepared: TrialScene,
    T_world_base: F64,
    plan: MotionPlan,
    disturbance: Disturbance,
    record: bool = False,
) -> TrialResult:
    """Executes a plan in a fresh physics scene.

    `T_world_base` (4, 4) is where the plan expects the mount; the disturbance says where things truly
    are. Equal arguments give equal results, bit by bit, whatever ran before. Never raises for what
    physics does: poses that are not finite end as `unstable`.
    """
    poses = (T_world_base, prepared.T_world_object, disturbance.T_target_moved, disturbance.T_base_moved)
    paths = (plan.q_reach_rad, plan.q_approach_rad, plan.q_lift_rad)
    if not all(np.isfinite(values).all() for values in (*poses, *paths)):
        return TrialResult("unstable", 0.0, 0.0, 0.0, 0.0)
    trial = _Trial(prepared, T_world_base @ disturbance.T_base_moved, plan, disturbance, record)
    outcome = (
        trial.settle()
        or trial.reach()
        or trial.approach()
        or trial.close()
        or trial.lift()
        or trial.hold()
        or "success"
    )
    return trial.result(outcome)


@dataclass(eq=False)
class _Trial:
    """A trial under way. Each phase returns the outcome that ended it, or None."""

    prepared: TrialScene
    T_world_base: F64  # where the base truly is
    plan: MotionPlan
    disturbance: Disturbance
    record: bool
    ticks: int = 0
    commanded: F64 = field(default_factory=lambda: np.zeros(0))  # (A + 2,) targets of the drives
    start_m: F64 = field(default_factory=lambda: np.zeros((0, 3)))
    risen_m: float = 0.0  # the target's highest rise so far
    T_tcp_target: F64 | None = None  # when the hand had closed
    gripped: bool = False
    moments: list[tuple[float, F64, F64, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        prepared, plan = self.prepared, self.plan
        params = prepared.params
        self.steps = max(1, round(params.control_period_s / params.timestep_s))
        self.lag_s = prepared.robot.damping / prepared.robot.stiffness
        mass_kg = prepared.mass_kg.copy()
        mass_kg[0] *= self.disturbance.mass_scale
        T_world_object = prepared.T_world_object.copy()
        T_world_object[0] = moved_target(prepared, self.disturbance.T_target_moved)
        self.world = TrialWorld(
            still_parts_near(prepared, self.T_world_base),
            pedestal_below(prepared, self.T_world_base),
            Things(prepared.parts_m, mass_kg, T_world_object),
            prepared.robot,
            prepared.articulation,
            self.T_world_base,
            self.disturbance.object_friction,
            params,
        )
        self.world.place_arm(plan.q_reach_rad[0], plan.opening_m)
        self.commanded = np.concatenate([plan.q_reach_rad[0], [plan.opening_m / 2] * 2])
        self.start_m = self.world.positions_m()
        self._note("reach")

    @cached_property
    def schedule(self) -> Schedule:
        return schedule_of(self.plan, self.prepared.robot, self.prepared.params)

    @cached_property
    def rise_m(self) -> float:
        """How far the plan lifts the hand."""
        T_base_tcp = self.prepared.robot.T_base_tcp
        before, after = T_base_tcp(self.plan.q_approach_rad[-1]), T_base_tcp(self.plan.q_lift_rad[-1])
        return float(after[2, 3] - before[2, 3])

    # -- phases -------------------------------------------------------------------------------------

    def settle(self) -> str | None:
        """Lets a target that was moved come to rest before the arm starts; the others sleep."""
        count = len(self.prepared.mass_kg)
        if np.array_equal(self.disturbance.T_target_moved, np.eye(4)):
            self.world.rest(range(count))
            return None
        self.world.rest(range(1, count))
        for _ in range(self._ticks_in(_SETTLE_S)):
            ended = self._tick("reach", self.commanded)
            if ended or self.world.speeds_mps().max() < _SETTLED_MPS:
                break
        else:
            ended = None
        self.start_m = self.world.positions_m()
        return ended

    def reach(self) -> str | None:
        """The path to the pregrasp."""
        return self._follow("reach", self.schedule.reach_rad) or self._arrive("reach")

    def approach(self) -> str | None:
        """The straight line to the grasp."""
        return self._follow("approach", self.schedule.approach_rad) or self._arrive("approach")

    def close(self) -> str | None:
        """Closes the fingers and presses with the grip's force."""
        params = self.prepared.params
        ticks = self._ticks_in(params.close_s)
        travelling = max(1, int(ticks * _CLOSING_SHARE))
        first, last = self.plan.opening_m / 2, -params.grip_force_n / FINGER_STIFFNESS
        for k in range(ticks):
            targets = self.commanded.copy()
            targets[-2:] = first + (last - first) * min(1.0, (k + 1) / travelling)
            if k >= travelling:
                targets[-2:] = self._pressing()
            if ended := self._tick("close", targets, look=k == ticks - 1):
                return ended
        q = self.world.joints
        if q[-2:].sum() < _EMPTY_OPENING_M or not self.gripped:
            return "missed"
        self.T_tcp_target = inverse(self._T_world_tcp(q)) @ self.world.T_world_object[0]
        return None

    def lift(self) -> str | None:
        """Lifts the hand, pressing on."""
        if ended := self._follow("lift", self.schedule.lift_rad, pressing=True):
            return ended
        if self.gripped and self.risen_m >= _RISEN_SHARE * self.rise_m:
            return None
        return self._lost()

    def hold(self) -> str | None:
        """Holds still, and decides."""
        ticks = self._ticks_in(self.prepared.params.hold_s)
        for k in range(ticks):
            targets = self.commanded.copy()
            targets[-2:] = self._pressing()
            if ended := self._tick("hold", targets, look=k == ticks - 1):
                return ended
        if not self.gripped:
            return self._lost()
        lifted = self._lift_m() >= _LIFTED_SHARE * self.rise_m
        return None if lifted and self._slip_m() <= self.prepared.params.max_slip_m else "slipped"

    # -- pieces of phases ---------------------------------------------------------------------------

    def _follow(self, phase: str, joints_rad: F64, pressing: bool = False) -> str | None:
        """Moves the arm through joints (N, A), a tick each."""
        led_rad = led(joints_rad, self.prepared.params.control_period_s, self.lag_s)
        arm = joints_rad.shape[1]
        for k in range(1, len(led_rad)):
            targets = self.commanded.copy()
            targets[:arm] = led_rad[k]
            if pressing:
                targets[-2:] = self._pressing()
            if ended := self._tick(phase, targets, look=pressing and k == len(led_rad) - 1):
                return ended
            if not pressing and np.abs(self.world.joints[:arm] - joints_rad[k]).max() > _BLOCKED_RAD:
                return "not_reached"
        return None

    def _arrive(self, phase: str) -> str | None:
        """Waits a little for the drives, and asks whether the hand is where it should be."""
        arm = len(self.commanded) - 2
        wanted = self.commanded[:arm]
        for _ in range(self._ticks_in(_ARRIVE_S)):
            if np.abs(self.world.joints[:arm] - wanted).max() <= _ARRIVED_RAD:
                break
            if ended := self._tick(phase, self.commanded):
                return ended
        q = self.world.joints[:arm]
        T_base_tcp = self.prepared.robot.T_base_tcp
        off_m = np.linalg.norm(T_base_tcp(q)[:3, 3] - T_base_tcp(wanted)[:3, 3])
        return "not_reached" if np.abs(q - wanted).max() > _JOINT_OFF_RAD or off_m > _TCP_OFF_M else None

    def _pressing(self) -> float:
        """Target of both fingers that presses with the grip's force, evenly about the object's middle.

        As in a hand whose fingers are coupled, a push along the closing axis moves one finger back
        and makes the other follow.
        """
        return float(self.world.joints[-2:].mean()) - self.prepared.params.grip_force_n / FINGER_STIFFNESS

    def _tick(self, phase: str, targets: F64, look: bool = False) -> str | None:
        """One control period. Where `look`, `gripped` says afterwards whether both fingers hold."""
        world, steps = self.world, self.steps
        if look:
            seen = min(_LOOK_STEPS, steps)
            world.drive(steps - seen, self.commanded, targets)
            self.gripped = False
            for _ in range(seen):
                world.drive(1, targets, targets)
                self.gripped = self.gripped or self._holds()
        else:
            world.drive(steps, self.commanded, targets)
        self.commanded = targets
        self.ticks += 1
        positions_m, speeds_mps = world.positions_m(), world.speeds_mps()
        if not (np.isfinite(positions_m).all() and speeds_mps.max() <= _SPEED_WITHOUT_SENSE_MPS):
            return "unstable"
        if np.abs(positions_m - self.start_m).max() > _GONE_M or not np.isfinite(world.joints).all():
            return "unstable"
        self.risen_m = max(self.risen_m, float(positions_m[0, 2] - self.start_m[0, 2]))
        self._note(phase)
        return None

    def _holds(self) -> bool:
        """Whether each finger pushed the target towards the other in the last step."""
        params = self.prepared.params
        closing = self._T_world_tcp(self.world.joints)[:3, 1]
        first, second = self.world.finger_impulses() @ closing / params.timestep_s
        least_n = _HOLDS_SHARE * params.grip_force_n
        return bool(first < -least_n and second > least_n)

    def _lost(self) -> str:
        return "dropped" if self.risen_m >= _RISEN_SHARE * self.rise_m else "slipped"

    def _ticks_in(self, seconds: float) -> int:
        return max(1, round(seconds / self.prepared.params.control_period_s))

    # -- measures -----------------------------------------------------------------------------------

    def _T_world_tcp(self, joints: F64) -> F64:
        return self.T_world_base @ self.prepared.robot.T_base_tcp(joints[:-2])

    def _lift_m(self) -> float:
        return float(self.world.positions_m()[0, 2] - self.start_m[0, 2])

    def _slip_m(self) -> float:
        """How far the point of the target that was between the pads has moved in the hand."""
        if self.T_tcp_target is None:
            return 0.0
        now = inverse(self._T_world_tcp(self.world.joints)) @ self.world.T_world_object[0]
        point_m = inverse(self.T_tcp_target)[:3, 3]
        return float(np.linalg.norm(now[:3, :3] @ point_m + now[:3, 3]))

    def _note(self, phase: str) -> None:
        if self.record:
            time_s = self.ticks * self.prepared.params.control_period_s
            self.moments.append((time_s, self.world.joints, self.world.T_world_object, phase))

    def result(self, outcome: str) -> TrialResult:
        """The trial's numbers, finite and within what a record takes."""
        positions_m = self.world.positions_m()
        moved_m = np.linalg.norm(positions_m[1:] - self.start_m[1:], axis=1)
        lift_m, slip_m, disturbed_m = (
            float(np.clip(np.nan_to_num(value, nan=0.0), -_LARGEST_M, _LARGEST_M))
            for value in (self._lift_m(), self._slip_m(), moved_m.max(initial=0.0))
        )
        simulated_s = self.ticks * self.prepared.params.control_period_s
        recording = _recording(self.moments) if self.record else None
        return TrialResult(outcome, lift_m, slip_m, disturbed_m, simulated_s, recording)


def _recording(moments: list[tuple[float, F64, F64, str]]) -> Recording:
    times, joints, poses, phases = zip(*moments, strict=True)
    q = np.stack(joints)
    return Recording(np.array(times), q[:, :-2], q[:, -2:].sum(axis=1), np.stack(poses), tuple(phases))

"""Execute one planned grasp in physics: reach, approach, close, lift, hold; and its outcome."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import inverse
from datagen.workers.motion import MotionPlan
from datagen.workers.trials import Disturbance, Recording, TrialResult
from datagen.workers.trials.drive_targets import (
    PHASES,
    ControlPeriod,
    drive_targets,
    planned_rise_m,
    pressing_target_m,
)
from datagen.workers.trials.physics import NEAR_M, TrialWorld
from datagen.workers.trials.trial_scene import (
    TrialScene,
    disturbed,
)

# Largest errors of a joint and of the TCP at the end of reach and approach.
_JOINT_OFF_RAD, _TCP_OFF_M = 0.05, 0.015
# Farther behind its path than this, the arm is pushing against something.
_BLOCKED_RAD = 0.3
_EMPTY_OPENING_M = 0.001
LIFTED_SHARE = 0.8  # share of the hand's planned rise that is a success
RISEN_SHARE = (
    0.5  # share of it from which a lost target counts as dropped, not slipped, and is off its support
)
# A finger holds where it pushes with at least this share of the grip's force along the closing axis.
HOLDS_SHARE = 0.1
_PLAYED_STEP_RAD = 0.04  # motion of the joint that moves farthest
_LOOK_STEPS = 4  # last steps of a phase, after each of which contacts are checked
# An object whose energy would carry it this much higher than the hand rises has been thrown by the solver.
_THROWN_M = 0.15
_SETTLE_S, _SETTLED_MPS = 0.4, 0.02
# Held for good: the target moves less than this in the hand in each of _STILL_PERIODS control periods.
_STILL_M, _STILL_RAD, _STILL_PERIODS = 0.0005, 0.01, 2
_IMPLAUSIBLE_MPS, _GONE_M = 20.0, 10.0
_LARGEST_M = 100.0


def run_trial(
    prepared: TrialScene,
    T_world_base: F64,
    plan: MotionPlan,
    disturbance: Disturbance,
    record: bool = False,
    whole: bool = False,
) -> TrialResult:
    """Execute a plan in a fresh physics scene.

    Three shortcuts save time: a reach that touches nothing is played back and not simulated, the solver takes
    fewer iterations until something is near the arm, and holding ends once the target rests in the hand.
    `whole` simulates everything in full.

    `T_world_base` (4, 4) is where the plan expects the mount; the disturbance has the true poses. Equal
    arguments give equal results, bit by bit, whatever ran before. Never raises for the physics: poses that
    are not finite end as `unstable`.
    """
    poses = (T_world_base, prepared.T_world_object, disturbance.T_target_moved, disturbance.T_base_moved)
    paths = (plan.q_reach_rad, plan.q_approach_rad, plan.q_lift_rad)
    if not all(np.isfinite(values).all() for values in (*poses, *paths)):
        return TrialResult("unstable", 0.0, 0.0, 0.0, 0.0)
    prepared = disturbed(prepared, disturbance)
    trial = _Trial(prepared, T_world_base @ disturbance.T_base_moved, plan, disturbance, record, whole)
    return trial.result(trial.run())


@dataclass(eq=False)
class _Trial:
    """A running trial. Methods that may end it return the outcome, or None."""

    prepared: TrialScene  # disturbed
    T_world_base: F64  # true pose of the base
    plan: MotionPlan
    disturbance: Disturbance
    record: bool
    whole: bool
    ticks: int = 0
    is_free: bool = False  # whether nothing has come near the arm so far
    commanded: F64 = field(default_factory=lambda: np.zeros(0))  # (A + 2,) targets of the drives
    start_m: F64 = field(default_factory=lambda: np.zeros((0, 3)))
    start_energy_m: F64 = field(default_factory=lambda: np.zeros(0))
    risen_m: float = 0.0  # highest rise so far of the target where it is grasped
    gripped: bool = False  # at the last check of contacts: whether both fingers hold
    supported: bool = False  # at the last check of contacts: whether anything but the robot pushed the target
    T_tcp_target: F64 | None = None  # when the hand had closed
    grasped_z_m: float = 0.0  # height of the TCP then
    T_tcp_held: F64 | None = None  # at the end of lifting, then after each control period of holding
    still_periods: int = 0  # periods of holding without a break in which the target hardly moved in the hand
    moments: list[tuple[float, F64, F64, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._build()

    def _build(self) -> None:
        prepared, plan, params = self.prepared, self.plan, self.prepared.params
        self.steps = max(1, round(params.control_period_s / params.timestep_s))
        friction = self.disturbance.object_friction
        self.world = TrialWorld(prepared, self.T_world_base, plan.opening_m, friction)
        self.world.place_arm(plan.q_reach_rad[0], plan.opening_m)
        self.commanded = np.concatenate([plan.q_reach_rad[0], [plan.opening_m / 2] * 2])
        self.ticks, self.is_free, self.moments = 0, False, []
        self._start()
        self._note(PHASES[0])

    def _start(self) -> None:
        self.start_m, self.start_energy_m = self.world.positions_m(), self.world.energies_m()

    def run(self) -> str:
        """Run all phases and return the outcome."""
        check_at_end = {
            "reach": self._arrived,
            "approach": self._arrived,
            "close": self._closed,
            "lift": self._lifted,
            "hold": self._held,
        }
        if ended := self._settle():
            return ended
        ticks = drive_targets(self.plan, self.prepared.robot, self.prepared.params)
        if not self.whole:
            reach = [tick for tick in ticks if tick.phase == "reach"]
            if self._played(reach):
                ticks = ticks[len(reach) :]
            else:
                self._build()
                if ended := self._settle():
                    return ended
        for tick in ticks:
            if ended := self._take(tick):
                return ended
            if tick.phase == "hold" and not self.whole and self._is_held_for_good():
                return self._held(tick) or "success"
            if tick.ends_phase and (ended := check_at_end[tick.phase](tick)):
                return ended
        return "success"

    def _settle(self) -> str | None:
        """Let a target that was moved come to rest before the arm starts; the other objects sleep."""
        count = len(self.prepared.mass_kg)
        if np.array_equal(self.disturbance.T_target_moved, np.eye(4)):
            self.world.rest(range(count))
            return None
        self.world.rest(range(1, count))
        for _ in range(round(_SETTLE_S / self.prepared.params.control_period_s)):
            if ended := self._step(PHASES[0], self.commanded):
                return ended
            if self.world.speeds_mps().max() < _SETTLED_MPS:
                break
        self._start()
        return None

    def _played(self, reach: list[ControlPeriod]) -> bool:
        """Put the arm along its reach to the end; False where it touches something on the way.

        In free space the drives follow a path without lag, and nothing else moves meanwhile.
        """
        world, opening_m = self.world, self.plan.opening_m
        self.is_free = True
        world.be_free(True)
        before = self.commanded[:-2]
        for tick in reach:
            steps = max(1, int(np.ceil(np.abs(tick.joints_rad - before).max() / _PLAYED_STEP_RAD)))
            for share in np.arange(1, steps + 1) / steps:
                if world.look_at(before + (tick.joints_rad - before) * share, opening_m) <= 0:
                    return False
            before = tick.joints_rad
            self.ticks += 1
            self._note(tick.phase)
        world.place_arm(before, opening_m)
        self.commanded = np.concatenate([before, [opening_m / 2] * 2])
        return True

    # -- a control period ---------------------------------------------------------------------------

    def _take(self, tick: ControlPeriod) -> str | None:
        finger_m, joints = tick.finger_m, self.world.joints
        if finger_m is None:
            finger_m = pressing_target_m(joints[-2:], self.prepared.params.grip_force_n)
        targets = np.concatenate([tick.arm_rad, [finger_m, finger_m]])
        grips = PHASES.index(tick.phase) >= PHASES.index("close")
        look = tick.phase == "hold" or (grips and tick.ends_phase)
        if ended := self._step(tick.phase, targets, look):
            return ended
        blocked = np.abs(self.world.joints[:-2] - tick.joints_rad).max() > _BLOCKED_RAD
        return "not_reached" if blocked and not grips else None

    def _step(self, phase: str, targets: F64, look: bool = False) -> str | None:
        """Simulate one control period. With `look`, check contacts and set `gripped` and `supported`."""
        world, steps = self.world, self.steps
        seen = min(_LOOK_STEPS, steps) if look else 0
        taken = 0
        if self.is_free:
            taken = world.drive_free(steps - seen, self.commanded, targets)
            if world.gap_m() < NEAR_M or look:
                self.is_free = False
                world.be_free(False)
        world.drive(steps - seen, self.commanded, targets, taken)
        if look:
            self.gripped = self.supported = False
            for _ in range(seen):
                world.drive(1, targets, targets)
                self.gripped = self.gripped or self._holds()
                self.supported = self.supported or world.is_supported()
        self.commanded = targets
        self.ticks += 1
        positions_m, joints, energies_m = world.positions_m(), world.joints, world.energies_m()
        if not (
            np.isfinite(positions_m).all() and np.isfinite(joints).all() and np.isfinite(energies_m).all()
        ):
            return "unstable"
        thrown = (energies_m - self.start_energy_m).max() > self.rise_m + _THROWN_M
        gone = np.abs(positions_m - self.start_m).max() > _GONE_M
        if thrown or gone or world.speeds_mps().max() > _IMPLAUSIBLE_MPS:
            return "unstable"
        self.risen_m = max(self.risen_m, self._lift_m())
        self._note(phase)
        return None

    def _holds(self) -> bool:
        """Whether each finger pushed the target towards the other in the last step."""
        params = self.prepared.params
        closing = self._T_world_tcp()[:3, 1]
        first, second = self.world.finger_impulses() @ closing / params.timestep_s
        least_n = HOLDS_SHARE * params.grip_force_n
        return bool(first < -least_n and second > least_n)

    # -- ends of phases -----------------------------------------------------------------------------

    def _arrived(self, tick: ControlPeriod) -> str | None:
        q = self.world.joints[:-2]
        T_base_tcp = self.prepared.robot.T_base_tcp
        off_m = np.linalg.norm(T_base_tcp(q)[:3, 3] - T_base_tcp(tick.joints_rad)[:3, 3])
        off_rad = np.abs(q - tick.joints_rad).max()
        return "not_reached" if off_rad > _JOINT_OFF_RAD or off_m > _TCP_OFF_M else None

    def _closed(self, tick: ControlPeriod) -> str | None:
        if self.world.joints[-2:].sum() < _EMPTY_OPENING_M or not self.gripped:
            return "missed"
        T_world_tcp = self._T_world_tcp()
        self.T_tcp_target = inverse(T_world_tcp) @ self.world.T_world_object[0]
        self.grasped_z_m, self.risen_m = float(T_world_tcp[2, 3]), 0.0
        return None

    def _lifted(self, tick: ControlPeriod) -> str | None:
        risen = self.risen_m >= RISEN_SHARE * self.rise_m
        self.T_tcp_held = inverse(self._T_world_tcp()) @ self.world.T_world_object[0]
        return None if self.gripped and risen else self._lost()

    def _held(self, tick: ControlPeriod) -> str | None:
        if not self.gripped:
            return self._lost()
        lifted = self._lift_m() >= LIFTED_SHARE * self.rise_m and self._is_off_its_support()
        return None if lifted and self._slip_m() <= self.prepared.params.max_slip_m else "slipped"

    def _is_held_for_good(self) -> bool:
        """Whether the target no longer moves in the hand; called after each control period of holding."""
        now = inverse(self._T_world_tcp()) @ self.world.T_world_object[0]
        before, self.T_tcp_held = self.T_tcp_held, now
        assert before is not None  # since the end of lifting
        moved_m = np.linalg.norm(now[:3, 3] - before[:3, 3])
        # For a rotation R by a small angle, the norm of R - I is sqrt(2) times the angle.
        turned_rad = np.linalg.norm(now[:3, :3] @ before[:3, :3].T - np.eye(3)) / np.sqrt(2)
        is_still = bool(moved_m < _STILL_M and turned_rad < _STILL_RAD)
        self.still_periods = self.still_periods + 1 if is_still else 0
        return self.still_periods >= _STILL_PERIODS

    def _lost(self) -> str:
        return "dropped" if self.risen_m >= RISEN_SHARE * self.rise_m else "slipped"

    # -- measures -----------------------------------------------------------------------------------

    @cached_property
    def rise_m(self) -> float:
        """Height in metres by which the plan lifts the hand."""
        return planned_rise_m(self.plan, self.prepared.robot)

    def _T_world_tcp(self) -> F64:
        return self.T_world_base @ self.prepared.robot.T_base_tcp(self.world.joints[:-2])

    def _grasped_m(self) -> F64:
        """World position (3,) of the target's point that was between the pads when the hand had closed."""
        assert self.T_tcp_target is not None
        T = self.world.T_world_object[0]
        return T[:3, :3] @ inverse(self.T_tcp_target)[:3, 3] + T[:3, 3]

    def _lift_m(self) -> float:
        """Rise of the target, metres: of its grasped point since the hand closed; before, of its frame."""
        if self.T_tcp_target is None:
            return float(self.world.positions_m()[0, 2] - self.start_m[0, 2])
        return float(self._grasped_m()[2] - self.grasped_z_m)

    def _slip_m(self) -> float:
        """Distance in metres that the grasped point has moved in the hand."""
        if self.T_tcp_target is None:
            return 0.0
        return float(np.linalg.norm(self._grasped_m() - self._T_world_tcp()[:3, 3]))

    def _is_off_its_support(self) -> bool:
        """Whether only the robot carries the target, or its lowest point has risen by `RISEN_SHARE`."""
        if not self.supported:
            return True
        corners_m = np.concatenate(self.prepared.parts_m[0]).astype(np.float64)
        T_start = self.prepared.T_world_object[0]
        was, now = ((corners_m @ T[2, :3] + T[2, 3]).min() for T in (T_start, self.world.T_world_object[0]))
        return bool(now - was >= RISEN_SHARE * self.rise_m)

    def _note(self, phase: str) -> None:
        if self.record:
            time_s = self.ticks * self.prepared.params.control_period_s
            self.moments.append((time_s, self.world.joints, self.world.T_world_object, phase))

    def result(self, outcome: str) -> TrialResult:
        """The trial's numbers, finite and within the ranges of a record."""
        moved_m = np.linalg.norm(self.world.positions_m()[1:] - self.start_m[1:], axis=1)
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

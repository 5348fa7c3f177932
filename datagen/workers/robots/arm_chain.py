"""The chain of an arm: the joints between base and tip, what is fixed to each, and its coordinates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from datagen.schemas.errors import InputError
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import translation
from datagen.workers.robots.hand import Hand
from datagen.workers.robots.links import cluster_of, refuse_followers, scaled_pose
from datagen.workers.robots.reach import Chain, largest_reach_m
from datagen.workers.robots.robot_file import RobotSource
from datagen.workers.robots.urdf import FIX, Joint, Link, UrdfTree, rpy_rotation

_REACH_TOLERANCE_M = 1e-6
_HELD_OUTSIDE = 1e-3  # by which a joint may be held outside its range, as where it was rounded
FEWEST, MOST = 4, 9  # coordinates
# Speeds of joints for which the URDF has none.
_SPEED_RADPS, _SPEED_MPS = 1.0, 0.2
TURN = "base_turn"  # the joint of a base that turns in place


class ArmChain:
    """The joints between base and tip, and the links that are fixed to each of them.

    Joint j of J stands at `ratio[j] * q[coordinate[j]] + offset[j]` for A coordinates q. They have names
    (`coordinates`), limits, speeds in radians or metres a second, and may be lengths (`slides`).
    """

    def __init__(self, source: RobotSource, tree: UrdfTree, palm: str) -> None:
        keys = source.keys
        self.tree, self.keys, self.turns = tree, keys, keys.base.presents == "turns"
        chain = tree.chain(keys.arm.base, keys.arm.tip)
        for name in (name for group in keys.arm.coupled for name in group):
            tree.joint(name)
        refuse_followers(source, tree, "arm.held", keys.arm.held)
        for name, position in keys.arm.held.items():
            low, high = tree.joint(name).lower, tree.joint(name).upper
            if not low - _HELD_OUTSIDE <= position <= high + _HELD_OUTSIDE:
                problem = f"is {position:g}, outside the range {low:g} to {high:g} of the joint"
                raise source.wrong(f"arm.held.{name}", problem, "Correct it: radians, or metres")
        self._joints = [j for j in chain if j.kind != "fixed" and tree.driver(j)[0].name not in keys.arm.held]
        if not self._joints:
            raise source.wrong(
                "arm.tip", f"no joint moves between {keys.arm.base} and {keys.arm.tip}", "Correct it"
            )
        self.names = [keys.arm.base, *(joint.child for joint in self._joints)]
        stops = {joint.name for joint in self._joints}
        own_hand = keys.hand.urdf is None
        above = tree.joint_above(palm) if own_hand and palm not in self.names else None
        stops |= {above.name} if above else set()
        x, y = keys.base.mount_m or (0.0, 0.0)
        T_head = translation(-x, -y, 0.0) if self.turns else None  # a base that turns about its mount
        self.clusters = [
            cluster_of(tree, head, stops, keys.arm.held, None if k else T_head)
            for k, head in enumerate(self.names)
        ]
        last = self.clusters[-1]
        if own_hand and palm == self.names[-1]:  # the hand's bodies hold what the last joint moves
            self.clusters[-1] = last = {palm: (Link(palm, None, (), ()), np.eye(4))}
            self.names[-1] += "-tip"
        self.T_tip_palm = self._tip_palm(source, palm)
        at_palm = above is not None and palm == keys.arm.tip
        self.T_tip = (
            last[above.parent][1] @ above.T_parent_child if at_palm and above else last[keys.arm.tip][1]
        )
        self._coordinates(source)

    def _tip_palm(self, source: RobotSource, palm: str) -> F64:
        mount, T = self.keys.hand.mount, np.eye(4)
        if mount is not None:
            T[:3, 3] = mount.xyz_m
            T[:3, :3] = rpy_rotation(np.array(mount.rpy_rad)) + 0.0  # no negative zero
            return T
        if self.keys.hand.urdf is None:
            for joint in self.tree.chain(self.keys.arm.tip, palm):
                if joint.kind != "fixed":
                    problem = f"joint {joint.name} moves between arm.tip and hand.palm"
                    raise source.wrong("hand.palm", problem, "Name a tip below it")
                T = T @ joint.T_parent_child
        return T

    def _coordinates(self, source: RobotSource) -> None:
        """Coordinates of the joints: shared by coupled and by mimic ones."""
        tree, coupled = self.tree, self.keys.arm.coupled
        rows: dict[str, int] = {TURN: 0} if self.turns else {}
        low, high = map(np.radians, self.keys.base.range_deg)
        limits = [(float(low), float(high))] if self.turns else []
        slides, speeds = ([False], [_SPEED_RADPS]) if self.turns else ([], [])
        columns = [(0, 1.0, 0.0)] if self.turns else []
        for joint in self._joints:
            driver, ratio, offset = tree.driver(joint)
            group = next((g for g in coupled if driver.name in g), (driver.name,))
            ratio /= len(group)
            name = group[0] if len(group) == 1 else "+".join(group)
            bounds = np.array(tree.limits(driver)) * len(group)
            if name not in rows:
                rows[name] = len(limits)
                limits.append((float(bounds[0]), float(bounds[1])))
                slides.append(driver.kind == "prismatic")
                known = 0 < driver.speed < np.inf
                speeds.append(
                    driver.speed * len(group) if known else _SPEED_MPS if slides[-1] else _SPEED_RADPS
                )
            k = rows[name]
            limits[k] = max(limits[k][0], float(bounds[0])), min(limits[k][1], float(bounds[1]))
            if (driver.kind == "prismatic") != slides[k]:
                raise source.wrong(
                    "arm.coupled", f"{driver.name} does not slide as the others do", "Correct the group"
                )
            columns.append((k, ratio, offset))
        if not FEWEST <= len(rows) <= MOST:
            fix = (
                "Hold joints in arm.held, or couple them in arm.coupled"
                if len(rows) > MOST
                else "Correct arm.base or arm.tip"
            )
            raise source.wrong(
                "arm", f"{len(rows)} joints move: {', '.join(rows)}; {FEWEST} to {MOST} may", fix
            )
        self.coordinates = tuple(rows)
        self.coordinate = np.array([k for k, _, _ in columns])
        self.ratio, self.offset = (np.array([column[n] for column in columns]) for n in (1, 2))
        self.lower, self.upper = np.array(limits).T.copy()
        self.speed, self.slides = np.array(speeds), np.array(slides)
        if self.turns:
            self.names = ["base_mount", *self.names]
            self.clusters = [{}, *self.clusters]

    def joints(self, scale: float) -> tuple[Joint, ...]:
        """The joints (J,) with scaled origins."""
        found: list[Joint] = []
        if self.turns:
            x, y = self.keys.base.mount_m or (0.0, 0.0)
            up = np.array([0.0, 0.0, 1.0])
            low, high = map(np.radians, self.keys.base.range_deg)
            found.append(
                Joint(
                    TURN,
                    "revolute",
                    self.names[0],
                    self.names[1],
                    translation(x, y, 0.0),
                    up,
                    low,
                    high,
                    1.0,
                )
            )
        for joint in self._joints:
            k = len(found)
            T = scaled_pose(self.clusters[k][joint.parent][1] @ joint.T_parent_child, scale)
            driver, ratio, offset = self.tree.driver(joint)
            lower, upper = sorted(ratio * limit + offset for limit in self.tree.limits(driver))
            kind = "prismatic" if joint.kind == "prismatic" else "revolute"
            child = self.names[k + 1]
            found.append(
                replace(
                    joint,
                    kind=kind,
                    parent=self.names[k],
                    child=child,
                    T_parent_child=T,
                    lower=lower,
                    upper=upper,
                )
            )
        return tuple(found)

    def palm(self, scale: float, tube_m: float) -> F64:
        """Pose (4, 4) of the palm in the frame of the last joint."""
        return scaled_pose(self.T_tip, scale) @ translation(0.0, 0.0, tube_m) @ self.T_tip_palm

    def chain(self, joints: tuple[Joint, ...], T_palm: F64, hand: Hand) -> Chain:
        """The joints, all of which turn, up to the TCP."""
        return Chain(
            np.stack([joint.T_parent_child for joint in joints]),
            np.stack([joint.axis for joint in joints]),
            self.lower,
            self.upper,
            (T_palm @ hand.T_palm_tcp)[:3, 3],
        )

    def scale_for(self, hand: Hand, tube_m: float, reach_m: float) -> float:
        """The scale at which the arm reaches `reach_m` by the secant method: it is nearly linear in it."""

        def reach_at(scale: float) -> float:
            return largest_reach_m(self.chain(self.joints(scale), self.palm(scale, tube_m), hand))

        low, high = 0.1, 1.0
        at_low, at_high = reach_at(low), reach_at(high)
        for _ in range(20):
            if at_high == at_low:
                break
            guess = low + (reach_m - at_low) * (high - low) / (at_high - at_low)
            at_guess = reach_at(guess)
            if abs(at_guess - reach_m) < _REACH_TOLERANCE_M:
                return guess
            low, at_low, high, at_high = high, at_high, guess, at_guess
        raise InputError(self.tree.path, "joints", f"no scale gives a reach of {reach_m} m", FIX)

"""Stored successes checked by a second implementation of kinematics: Bullet, from the robots' own URDFs.

    python -m benchmarks.second_kinematics RUN... [--most 200]

Runs of `plan` or `sim` by a robot that is not scaled; needs the extra `pybullet`. Bullet places the palm at
the stored joints of each success, and this prints

- how far that puts the TCP from the stored pose of the hand: mm and degrees, mean and largest
- successes with a joint outside the limits that Bullet reads
- how far the TCP lies from the tool frame of the hand's makers, mm, where the URDF has one

The mount, coupled joints and the hand's flange are worked out here again. Only the pose of the TCP in the
palm and the height of the mount are taken from the robot.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pybullet  # pyright: ignore[reportMissingImports]  # no wheels from Python 3.12 on

from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.shard_reading import read_scenes
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import inverse, translation, yaw_pose
from datagen.workers.labels.arm_labelling import arm_of
from datagen.workers.robots import open_robot, robot_source
from datagen.workers.robots.resources import resource
from datagen.workers.robots.robot import Robot

Record = dict[str, np.ndarray[Any, Any]]

TOOL_FRAMES = ("link_grasp_center", "r_gripper_tool_frame", "panda_hand_tcp")
ROUNDING = 1e-6  # joints are stored as float32


@dataclass(frozen=True)
class BulletJoint:
    """A joint as Bullet reads it; it moves the link of the same index."""

    name: str
    kind: int
    lower: float
    upper: float  # not above `lower` where there are no limits
    link: str
    parent: int


class BulletTree:
    """The joints of a URDF in Bullet, the root link at the origin; shapes and masses are left out."""

    def __init__(self, urdf: Path) -> None:
        document = ElementTree.parse(urdf)
        for link in document.getroot().findall("link"):
            for part in list(link):
                link.remove(part)
            # Without one Bullet prints a warning a link; its origin is the link's own.
            inertial = ElementTree.SubElement(link, "inertial")
            ElementTree.SubElement(inertial, "mass", value="1")
            moments = {"ixx": "1", "iyy": "1", "izz": "1", "ixy": "0", "ixz": "0", "iyz": "0"}
            ElementTree.SubElement(inertial, "inertia", moments)
        self._client: int = pybullet.connect(pybullet.DIRECT)
        with tempfile.NamedTemporaryFile(suffix=".urdf") as file:
            document.write(file.name)
            self._body: int = pybullet.loadURDF(file.name, useFixedBase=True, physicsClientId=self._client)
        self.joints: list[BulletJoint] = []
        for k in range(pybullet.getNumJoints(self._body, self._client)):
            row = pybullet.getJointInfo(self._body, k, self._client)
            self.joints.append(
                BulletJoint(row[1].decode(), row[2], row[8], row[9], row[12].decode(), row[16])
            )
        self._row = {joint.link: k for k, joint in enumerate(self.joints)}

    def __contains__(self, link: str) -> bool:
        return link in self._row

    def chain(self, base: str, tip: str) -> list[BulletJoint]:
        """The joints that move between two links, from the base on."""
        found: list[BulletJoint] = []
        k, last = self._row[tip], self._row.get(base, -1)
        while k != last:
            found.insert(0, self.joints[k])
            k = self.joints[k].parent
        return [joint for joint in found if joint.kind != pybullet.JOINT_FIXED]

    def move(self, positions: Mapping[str, float]) -> None:
        """Move these joints, radians or metres, and all others to 0."""
        for k, joint in enumerate(self.joints):
            at = positions.get(joint.name, 0.0)
            pybullet.resetJointState(self._body, k, at, physicsClientId=self._client)

    def between(self, parent: str, child: str) -> F64:
        """Pose (4, 4) of a link in the frame of another."""
        return inverse(self._pose(parent)) @ self._pose(child)

    def _pose(self, link: str) -> F64:
        if link not in self._row:  # the root
            return np.eye(4)
        state = pybullet.getLinkState(self._body, self._row[link], 0, 1, physicsClientId=self._client)
        return _pose(state[4], state[5])


class SecondRobot:
    """A robot of which Bullet says where the TCP is."""

    def __init__(self, robot: Robot) -> None:
        keys, folder = robot.source.keys, robot.source.path.parent
        self._keys, self._palm = keys.arm, keys.hand.palm or keys.arm.tip
        self._tree = hand = BulletTree(resource(keys.urdf, folder, folder, "urdf"))
        self._turns = keys.base.presents == "turns"
        # The joints of each coordinate: their sum, where several are coupled.
        self.coordinates: list[list[BulletJoint]] = []
        for joint in self._tree.chain(keys.arm.base, keys.arm.tip):
            coupled = next((group for group in keys.arm.coupled if joint.name in group), ())
            if self.coordinates and self.coordinates[-1][0].name in coupled:
                self.coordinates[-1].append(joint)
            elif joint.name not in keys.arm.held:
                self.coordinates.append([joint])
        self._T_tip_palm, self._has_own_hand = np.eye(4), keys.hand.urdf is None
        if keys.hand.urdf is not None:
            hand = BulletTree(resource(keys.hand.urdf, folder, folder, "hand.urdf"))
            hand.move({})
        if keys.hand.mount is not None:
            turn = pybullet.getQuaternionFromEuler(keys.hand.mount.rpy_rad)
            self._T_tip_palm, self._has_own_hand = _pose(keys.hand.mount.xyz_m, turn), False
        self._tree.move({})
        # The foot of an arm on a pedestal or on a base that its URDF lacks, else the first joint that turns.
        mount_m = np.zeros(3)
        if robot.base_radius_m is not None and robot.base.deck_m is None:
            first = next(each[0] for each in self.coordinates if each[0].kind == pybullet.JOINT_REVOLUTE)
            mount_m = self._tree.between(keys.arm.base, first.link)[:3, 3]
            if self._turns or keys.base.mount_m is not None:
                mount_m[:2] = keys.base.mount_m or 0.0
        self._T_mount_base = translation(*-mount_m)
        self._T_palm_tcp = robot.assembly.hand.T_palm_tcp
        tool = next((name for name in TOOL_FRAMES if name in hand), None)
        gap_m = hand.between(self._palm, tool)[:3, 3] - self._T_palm_tcp[:3, 3] if tool else None
        self.tool_gap_m = np.nan if gap_m is None else float(np.linalg.norm(gap_m))

    def T_mount_tcp(self, q: F64) -> F64:
        """Pose (4, 4) of the TCP in the mount's frame at the coordinates (A,)."""
        T = self._T_mount_base
        if self._turns:  # about the vertical through the mount
            T, q = yaw_pose(0.0, 0.0, 0.0, float(q[0])) @ T, q[1:]
        positions = dict(self._keys.held)
        for value, joints in zip(q.tolist(), self.coordinates, strict=True):
            positions |= {joint.name: value / len(joints) for joint in joints}
        self._tree.move(positions)
        T = T @ self._tree.between(self._keys.base, self._palm if self._has_own_hand else self._keys.tip)
        return T @ self._T_tip_palm @ self._T_palm_tcp

    def least_margin(self, q: F64) -> float:
        """The least share of a joint's range between it and a limit; negative outside."""
        shares = [1.0]
        for value, joints in zip(q[int(self._turns) :].tolist(), self.coordinates, strict=True):
            for joint in joints:
                if joint.upper > joint.lower:
                    gap = min(value / len(joints) - joint.lower, joint.upper - value / len(joints))
                    shares.append(gap / (joint.upper - joint.lower))
        return min(shares)


def main() -> None:
    """Print a row for each run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="RUN")
    parser.add_argument("--most", type=int, default=200, help="successes to check in each run")
    options = parser.parse_args()
    print("robot       checked  mm mean  largest  degrees, largest  outside  tool frame mm")
    for path in options.runs:
        _print_run(Run.open(path), options.most)


def _print_run(run: Run, most: int) -> None:
    spec, per_shard = run.manifest.spec, run.layout.scenes_per_shard
    arm = arm_of(spec)
    name, key = arm.robot, arm.robot_key
    if robot_source(key).keys.scaled is not None:
        problem = f"{name} is scaled to a reach, and no URDF has its links"
        raise InputError(run.storage.url, "arm.robot", problem, "Give runs of other robots")
    scenes = [k * per_shard + n for k in sorted(run.committed()) for n in range(per_shard)]
    rows: list[tuple[float, float, float]] = []
    second: SecondRobot | None = None
    for record, sample in _successes(run, scenes):
        if second is None:
            second = SecondRobot(
                open_robot(key, float(sample["arm_reach_m"]), float(sample["base_height_m"]))
            )
        x_m, y_m = sample["base_xy_m"].tolist()
        T_world_mount = yaw_pose(x_m, y_m, float(sample["base_height_m"]), float(sample["base_yaw_rad"]))
        q = sample["q_grasp_rad"].astype(np.float64)
        T_found = T_world_mount @ second.T_mount_tcp(q)
        T_stored = record["T_world_object"][0] @ sample["T_target_tcp"].astype(np.float64)
        apart = inverse(T_stored) @ T_found
        # Through the sine: the cosine of a small angle is 1 in float32.
        R = apart[:3, :3] - apart[:3, :3].T
        sine = min(float(np.linalg.norm([R[2, 1], R[0, 2], R[1, 0]])) / 2, 1.0)
        angle_deg = np.degrees(np.arctan2(sine, (np.trace(apart[:3, :3]) - 1) / 2))
        rows.append((1e3 * float(np.linalg.norm(apart[:3, 3])), angle_deg, second.least_margin(q)))
        if len(rows) == most:
            break
    if second is None:
        print(f"{name:<12}{0:7d}  no success")
        return
    gap_mm, angle_deg, margin = np.array(rows).T
    outside = int((margin < -ROUNDING).sum())
    print(
        f"{name:<12}{len(rows):7d}{gap_mm.mean():9.5f}{gap_mm.max():9.5f}{angle_deg.max():18.6f}"
        f"{outside:9d}{1e3 * second.tool_gap_m:15.1f}"
    )


def _successes(run: Run, scenes: list[int]) -> Iterator[tuple[Record, Record]]:
    """The scene's record and the sample of each success."""
    for scene in read_scenes(run, scenes):
        for row in np.flatnonzero(scene.samples["label"]):
            yield dict(scene.record), {name: values[row] for name, values in scene.samples.items()}


def _pose(xyz_m: tuple[float, ...], xyzw: tuple[float, ...]) -> F64:
    T = np.eye(4)
    T[:3, :3] = np.array(pybullet.getMatrixFromQuaternion(xyzw)).reshape(3, 3)
    T[:3, 3] = xyz_m
    return T


if __name__ == "__main__":
    main()

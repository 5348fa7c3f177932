"""Robots in SAPIEN: the same places of links as pinocchio's, and drives that hold the tucked poses."""

import warnings
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="pinocchio cannot be imported here: run `datagen doctor`")
pytest.importorskip("sapien", reason="SAPIEN cannot be imported here: run `datagen doctor`")
with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import sapien
    from sapien import physx
    from sapien.wrapper.urdf_loader import URDFLoader

from datagen.workers.robots.robot import Robot
from datagen.workers.trials.physics import ARM
from examples.maniskill.robot_files import write_urdf
from tests.workers.robots.robots_under_test import CASES, opened

STEP_S = 1 / 200


@pytest.fixture(params=CASES)
def robot(request: pytest.FixtureRequest) -> Robot:
    return opened(request.param)


class Simulated:
    """The robot's own files in a fresh scene, driven as ManiSkill's agents drive: no gravity on its links."""

    def __init__(self, robot: Robot) -> None:
        self.scene = sapien.Scene([physx.PhysxCpuSystem()])
        self.scene.set_timestep(STEP_S)
        loader = URDFLoader()
        loader.fix_root_link = True
        loader.set_scene(self.scene)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with TemporaryDirectory() as folder:
                self.body = loader.load(str(write_urdf(robot, Path(folder))))
            self.body.set_root_pose(sapien.Pose(robot.T_base_root))
        self.links = {link.name: link for link in self.body.links}
        self.joints = self.body.active_joints
        self.names = [joint.name for joint in self.joints]
        self.robot = robot
        for link in self.body.links:
            link.disable_gravity = True
            for shape in link.collision_shapes:
                shape.set_collision_groups(ARM)  # as in trials, links do not collide with each other
        for joint in self.joints:
            drive = robot.drive
            slides = joint.type == "prismatic"
            stiffness = drive.slide_stiffness if slides else drive.stiffness
            force = drive.slide_force_limit if slides else drive.force_limit
            joint.set_drive_properties(stiffness, stiffness * drive.damping / drive.stiffness, force)

    def place(self, q_rad: np.ndarray) -> np.ndarray:
        """Sets joints and targets, fingers open; returns the joints in the engine's order."""
        assembly = self.robot.assembly
        positions = self.robot.coordinates(q_rad)
        values = dict(zip((joint.name for joint in assembly.arm), positions, strict=True))
        values |= dict(zip((joint.name for joint in assembly.hand.joints), assembly.hand.open, strict=True))
        q = np.array([values[name] for name in self.names])
        self.body.set_qpos(q)
        self.body.set_qvel(np.zeros_like(q))
        for joint, value in zip(self.joints, q, strict=True):
            joint.set_drive_target(value)
        return q


def test_joints_and_links_are_those_of_the_files(robot: Robot) -> None:
    simulated = Simulated(robot)
    arm, hand = robot.assembly.arm, robot.assembly.hand
    assert set(simulated.names) == {joint.name for joint in (*arm, *hand.joints)}
    assert set(robot.link_names) == set(simulated.links)
    for name, parts in zip(robot.link_names, robot.link_parts_m, strict=True):
        assert len(simulated.links[name].collision_shapes) == len(parts)
    limits = {joint.name: joint.limits[0] for joint in simulated.joints}
    ours = [(joint.lower, joint.upper) for joint in arm]
    np.testing.assert_allclose([limits[joint.name] for joint in arm], ours, atol=1e-6)


def test_links_are_where_pinocchio_puts_them(robot: Robot) -> None:
    simulated = Simulated(robot)
    rng = np.random.default_rng(0)
    for q in rng.uniform(robot.q_lower_rad, robot.q_upper_rad, (20, len(robot.joint_names))):
        simulated.place(q)
        poses = [simulated.links[name].entity_pose.to_transformation_matrix() for name in robot.link_names]
        # Single precision over a metre.
        np.testing.assert_allclose(robot.T_base_link(q), poses, atol=2e-6)


@pytest.mark.parametrize("payload_kg", [0.0, 1.0])
def test_drives_hold_every_home(robot: Robot, payload_kg: float) -> None:
    weight = [0.0, 0.0, -9.81 * payload_kg]
    for home in robot.homes_rad:
        simulated = Simulated(robot)
        q = simulated.place(home)
        hand = simulated.links[robot.link_names[robot.first_hand_link]]
        tcp = robot.T_base_tcp(home)[:3, 3]
        for _ in range(int(1.0 / STEP_S)):
            hand.add_force_at_point(weight, tcp)
            simulated.scene.step()
        arm = [simulated.names.index(joint.name) for joint in robot.assembly.arm]
        assert np.degrees(np.abs(simulated.body.qpos - q)[arm]).max() < 1.0

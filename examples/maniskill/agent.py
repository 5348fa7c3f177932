"""A robot as an agent of ManiSkill, whose joints follow their targets as in a trial.

Never imported by a worker: ManiSkill loads torch and every environment it has.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.controllers.pd_joint_pos import (
    PDJointPosController,
    PDJointPosControllerConfig,
    PDJointPosMimicController,
    PDJointPosMimicControllerConfig,
)
from mani_skill.agents.registration import register_agent

from datagen.schemas.errors import InputError
from datagen.workers.robots.robot import Robot
from datagen.workers.trials.drive_targets import FINGER_DAMPING, FINGER_STIFFNESS
from examples.maniskill.robot_files import write_urdf


class _FromLastTarget(PDJointPosController):
    """Interpolates from the last target to the next; ManiSkill's controller starts from the joints."""

    def set_action(self, action: Any) -> None:
        start = torch.as_tensor(self._target_qpos).clone()
        super().set_action(action)
        self._start_qpos = start
        self._step_size = (torch.as_tensor(self._target_qpos) - start) / self._sim_steps


class _FingersFromLastTarget(_FromLastTarget, PDJointPosMimicController):
    """One action for both fingers."""


@dataclass
class _ArmConfig(PDJointPosControllerConfig):
    controller_cls = _FromLastTarget


@dataclass
class _FingersConfig(PDJointPosMimicControllerConfig):
    controller_cls = _FingersFromLastTarget


@lru_cache(maxsize=64)
def agent_of(robot: Robot, grip_force_n: float) -> type[BaseAgent]:
    """A registered ManiSkill agent for a robot, with control mode `pd_joint_pos` alone.

    Actions (A + 1,): targets of the arm's joints in radians and of both fingers in metres, not normalised.
    """
    if robot.gripper.linkage is not None or not robot.coordinates.are_joints:
        fix = "Use a robot with two sliding fingers and a coordinate for every joint, such as panda or fetch"
        raise InputError("DatagenGrasp-v1", robot.name, "cannot be an agent of ManiSkill", fix)
    first, second = (joint.name for joint in robot.assembly.hand.joints)
    drive = robot.drive
    stiffness = np.where(robot.slides, drive.slide_stiffness, drive.stiffness)
    force = np.where(robot.slides, drive.slide_force_limit, drive.force_limit)

    class DatagenArm(BaseAgent):
        uid = f"datagen-{robot.name}-{robot.reach_m!r}-{robot.base_height_m!r}-{grip_force_n:g}"
        files = TemporaryDirectory(prefix="datagen-robot-")  # removed when the process ends
        urdf_path = str(write_urdf(robot, Path(files.name)))
        disable_self_collisions = True

        @property
        def _controller_configs(self) -> Any:
            arm = _ArmConfig(
                list(robot.joint_names), None, None, stiffness.tolist(),
                (stiffness * drive.damping / drive.stiffness).tolist(), force.tolist(),
                interpolate=True, normalize_action=False,
            )  # fmt: skip
            fingers = _FingersConfig(
                [first, second],
                -grip_force_n / FINGER_STIFFNESS,
                robot.gripper.max_opening_m / 2,
                FINGER_STIFFNESS,
                FINGER_DAMPING,
                grip_force_n,
                interpolate=True,
                normalize_action=False,
                mimic={second: {"joint": first}},  # pyright: ignore[reportArgumentType]
            )
            return {"pd_joint_pos": {"arm": arm, "gripper": fingers}}

    return register_agent()(DatagenArm)

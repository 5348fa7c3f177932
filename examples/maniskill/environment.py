"""The same trials as a registered ManiSkill environment, `DatagenGrasp-v1`, to train or run policies in.

Never imported by a worker: ManiSkill loads torch and every environment it has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.building.actor_builder import ActorBuilder
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Actor, Link, Pose
from sapien import physx

from datagen.schemas.errors import InputError
from datagen.schemas.specification import TrialParams
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import inverse
from datagen.workers.motion import MotionPlan
from datagen.workers.robots.robot import Robot
from datagen.workers.settling.sapien_physics import sapien_pose
from datagen.workers.trials import Disturbance
from datagen.workers.trials.drive_targets import (
    drive_targets,
    planned_rise_m,
    pressing_target_m,
)
from datagen.workers.trials.execute import HOLDS_SHARE, LIFTED_SHARE, RISEN_SHARE
from datagen.workers.trials.physics import (
    ARM,
    CARRIER,
    CONTACT_OFFSET_M,
    PEDESTAL,
    POSITION_ITERATIONS,
    SHOULDER,
    SLEEP_THRESHOLD,
    STILL,
    VELOCITY_ITERATIONS,
    still_body,
    thing_body,
    tune_pad,
    tune_shape,
)
from datagen.workers.trials.trial_scene import TrialScene, disturbed, pedestal_below, still_parts_near
from examples.maniskill.agent import agent_of

ENV_ID = "DatagenGrasp-v1"
_MAX_TICKS = 1000
_RISING_M = 0.002  # from this rise on, a hand that holds the target lifts it
_TOUCHES_N = 1e-3


@dataclass(frozen=True, eq=False)
class GraspTask:
    """The task of one environment: the arguments of `run_trial`."""

    prepared: TrialScene
    T_world_base: F64  # (4, 4), where the plan expects the mount
    plan: MotionPlan
    disturbance: Disturbance

    @property
    def T_world_true_base(self) -> F64:
        return self.T_world_base @ self.disturbance.T_base_moved


class _BodyBuilder(ActorBuilder):
    """Builds a given body: ManiSkill's builder reads hulls from files alone."""

    def __init__(
        self, body: physx.PhysxRigidBaseComponent, kind: str, env: int, T_world_body: F64, scene: Any
    ) -> None:
        super().__init__()
        self.body = body
        self.set_physx_body_type(kind)
        self.set_scene_idxs([env])
        self.set_scene(scene)
        self.initial_pose = sapien_pose(T_world_body)

    def build_physx_component(self, link_parent: Any = None) -> physx.PhysxRigidBaseComponent:
        return self.body


@register_env(ENV_ID, max_episode_steps=_MAX_TICKS)
class DatagenGraspEnv(BaseEnv):
    """One grasp task in each of `len(tasks)` environments, all with the same robot and parameters.

    On `physx_cuda` all environments step together; on `physx_cpu` there is one. Every reset builds new
    physics scenes, as a trial does; `reconfiguration_freq=0` reuses them, but outcomes then depend on
    earlier episodes.
    """

    SUPPORTED_OBS_MODES = ("state", "state_dict", "none")
    SUPPORTED_REWARD_MODES = ("sparse", "none")

    def __init__(self, *args: Any, tasks: Sequence[GraspTask], **kwargs: Any) -> None:
        self.tasks = tuple(tasks)
        if not self.tasks:
            raise InputError(ENV_ID, "tasks", "are missing", "Give one task per environment")
        self.robot: Robot = self.tasks[0].prepared.robot
        self.params: TrialParams = self.tasks[0].prepared.params
        if any(
            t.prepared.robot.assembly is not self.robot.assembly or t.prepared.params != self.params
            for t in self.tasks
        ):
            fix = "Make one environment for each robot and set of parameters"
            raise InputError(ENV_ID, "tasks", "differ in robot or parameters", fix)
        self.scripts = [drive_targets(t.plan, self.robot, self.params) for t in self.tasks]
        self.rises_m = [planned_rise_m(task.plan, self.robot) for task in self.tasks]
        kwargs = {"sim_backend": "physx_cpu", "render_backend": "none", "reconfiguration_freq": 1} | kwargs
        super().__init__(
            *args,
            num_envs=len(self.tasks),
            robot_uids=agent_of(self.robot, self.params.grip_force_n).uid,
            control_mode="pd_joint_pos",
            sim_config={
                "sim_freq": round(1 / self.params.timestep_s),
                "control_freq": round(1 / self.params.control_period_s),
                "spacing": 20,
                "scene_config": {
                    "contact_offset": CONTACT_OFFSET_M,
                    "solver_position_iterations": POSITION_ITERATIONS,
                    "solver_velocity_iterations": VELOCITY_ITERATIONS,
                    "sleep_threshold": SLEEP_THRESHOLD,
                },
            },
            **kwargs,
        )

    # -- building -----------------------------------------------------------------------------------

    @property
    def _default_sensor_configs(self) -> list[Any]:
        return []

    def _load_lighting(self, options: dict[str, Any]) -> None:
        """No lights: nothing here is rendered."""

    def _load_agent(self, options: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        super()._load_agent(options, self._root_poses(), build_separate=True)
        base, shoulder, *_, palm, first, second = self.robot.link_names
        fingers = (first, second)
        for link in self.agent.robot.get_links():
            groups = CARRIER if link.name == base else SHOULDER if link.name == shoulder else ARM
            for env, body in enumerate(link._objs):  # pyright: ignore[reportPrivateUsage]
                friction = self.tasks[env].disturbance.object_friction
                for shape in body.get_collision_shapes():
                    tune_shape(shape, groups)
                    shape.set_physical_material(physx.PhysxMaterial(friction, friction, 0.0))
                    if link.name in fingers:
                        pad_m = sum(self.robot.gripper.pad_size_m) / 2
                        tune_pad(shape, friction, self.params.finger_friction, pad_m)
        links = self.agent.robot.links_map
        self.fingers: list[Link] = [links[name] for name in fingers]
        self.palm: Link = links[palm]
        q = self.robot.homes_rad[0]
        T_base_palm = self.robot.T_base_link(q)[self.robot.link_names.index(palm)]
        T_palm_tcp = inverse(T_base_palm) @ self.robot.T_base_tcp(q)
        self.palm_tcp = Pose.create(sapien_pose(T_palm_tcp), device=self.device)

    def _load_scene(self, options: dict[str, Any]) -> None:
        targets: list[Actor] = []
        self.things: list[tuple[Actor, sapien.Pose]] = []
        for env, task in enumerate(self.tasks):
            prepared, friction = task.prepared, task.disturbance.object_friction
            T_base = task.T_world_true_base
            still = still_body(still_parts_near(prepared, T_base), STILL, friction)
            self._build(still, "static", env, np.eye(4), "still")
            pedestal_m = pedestal_below(prepared, T_base)
            if pedestal_m is not None:
                pedestal = still_body([pedestal_m], PEDESTAL, friction)
                self._build(pedestal, "static", env, np.eye(4), "pedestal")
            things = disturbed(prepared, task.disturbance)
            rows = zip(things.parts_m, things.mass_kg, things.T_world_object, strict=True)
            for k, (parts, mass, T) in enumerate(rows):
                body = thing_body(parts, float(mass), friction)
                actor = self._build(body, "dynamic", env, T, f"thing-{k}")
                self.things.append((actor, sapien_pose(T)))
                if k == 0:
                    targets.append(actor)
        self.target = targets[0] if len(targets) == 1 else Actor.merge(targets, name="target")

    def _build(
        self, body: physx.PhysxRigidBaseComponent, kind: str, env: int, T_world_body: F64, name: str
    ) -> Actor:
        return _BodyBuilder(body, kind, env, T_world_body, self.scene).build(name=f"{name}-{env}")

    def _root_poses(self) -> Pose:
        T = [t.T_world_true_base @ self.robot.T_base_root for t in self.tasks]
        rows = [np.concatenate([p.p, p.q]) for p in map(sapien_pose, T)]
        return Pose.create(torch.tensor(np.stack(rows), dtype=torch.float32, device=self.device))

    # -- episodes -----------------------------------------------------------------------------------

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict[str, Any]) -> None:
        if len(env_idx) != self.num_envs:
            fix = "Reset them together, or make environments of their own"
            raise InputError(ENV_ID, "env_idx", "environments are reset one by one", fix)
        for actor, at in self.things:
            actor.set_pose(Pose.create(at, device=self.device))
            actor.set_linear_velocity(torch.zeros(3))
            actor.set_angular_velocity(torch.zeros(3))
        robot = self.agent.robot
        robot.set_pose(self._root_poses())  # pyright: ignore[reportArgumentType]
        active = [joint.name for joint in robot.get_active_joints()]
        names = (*self.robot.joint_names, *(joint.name for joint in self.robot.assembly.hand.joints))
        q = np.zeros((self.num_envs, len(active)), np.float32)
        for env, task in enumerate(self.tasks):
            start = [*task.plan.q_reach_rad[0], task.plan.opening_m / 2, task.plan.opening_m / 2]
            q[env, [active.index(name) for name in names]] = start
        robot.set_qpos(torch.from_numpy(q).to(self.device))
        robot.set_qvel(torch.zeros_like(torch.from_numpy(q)).to(self.device))
        self.finger_columns = [active.index(name) for name in names[-2:]]
        # (N, 3): the point of the target between the pads when they held it and had not yet lifted it, its
        # height (N,) then, and the hand's when they first held it.
        self.held_at = torch.zeros((self.num_envs, 3), device=self.device)
        self.held_z_m, self.hand_z_m = (torch.zeros(self.num_envs, device=self.device) for _ in range(2))
        self.was_held = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self.start_low_m = self._lowest_m()

    def evaluate(self) -> dict[str, torch.Tensor]:
        """Success as in `run_trial`: the target is off its support, between both fingers, with little slip.

        Rise and slip are those of the point that was between the pads when the hand began to rise. After the
        last action of the plan it is the trial's outcome. Shapes (N,).
        """
        tcp = self.palm.pose * self.palm_tcp
        matrix = tcp.to_transformation_matrix()
        closing = matrix[:, :3, 1]
        by_link = {
            link.name: self.scene.get_pairwise_contact_forces(link, self.target)
            for link in self.agent.robot.get_links()
        }
        on_first, on_second = ((by_link[finger.name] * closing).sum(dim=1) for finger in self.fingers)
        least_n = HOLDS_SHARE * self.params.grip_force_n
        held = (on_first > least_n) & (on_second < -least_n)
        by_others = self.target.get_net_contact_forces() + torch.stack(list(by_link.values())).sum(dim=0)
        target = self.target.pose.to_transformation_matrix()
        now = torch.linalg.solve(target, matrix)[:, :3, 3]
        self.hand_z_m = torch.where(self.was_held, self.hand_z_m, matrix[:, 2, 3])
        fresh = ~self.was_held | (matrix[:, 2, 3] - self.hand_z_m < _RISING_M)
        self.held_at = torch.where(fresh[:, None], now, self.held_at)
        self.held_z_m = torch.where(fresh, matrix[:, 2, 3], self.held_z_m)
        self.was_held = self.was_held | held
        slip_m = torch.linalg.norm(now - self.held_at, dim=1)
        point_m = (target[:, :3, :3] @ self.held_at[:, :, None])[:, :, 0] + target[:, :3, 3]
        lift_m = point_m[:, 2] - self.held_z_m
        planned_m = torch.tensor(self.rises_m, device=self.device, dtype=lift_m.dtype)
        is_alone = torch.linalg.norm(by_others, dim=1) <= _TOUCHES_N
        is_clear = self._lowest_m() - self.start_low_m >= RISEN_SHARE * planned_m
        success = held & (is_alone | is_clear) & (lift_m >= LIFTED_SHARE * planned_m)
        success &= slip_m <= self.params.max_slip_m
        return {"success": success, "held": held, "lift_m": lift_m, "slip_m": slip_m}

    def _lowest_m(self) -> torch.Tensor:
        """Height (N,) of the targets' lowest points."""
        target = self.target.pose.to_transformation_matrix().cpu().numpy().astype(np.float64)
        lowest = [
            (np.concatenate(task.prepared.parts_m[0]) @ T[2, :3] + T[2, 3]).min()
            for task, T in zip(self.tasks, target, strict=True)
        ]
        return torch.tensor(lowest, dtype=torch.float32, device=self.device)

    def _get_obs_extra(self, info: dict[str, Any]) -> dict[str, torch.Tensor]:
        tcp = self.palm.pose * self.palm_tcp
        return {"tcp_pose": tcp.raw_pose, "target_pose": self.target.pose.raw_pose, "held": info["held"]}

    # -- the plan as actions ------------------------------------------------------------------------

    @property
    def plan_ticks(self) -> int:
        """Actions until every environment's plan is done."""
        return max(len(script) for script in self.scripts)

    def plan_action(self) -> torch.Tensor:
        """The plans' actions (N, A + 1) of the next step; the last one again where a plan is done."""
        step = int(self._elapsed_steps.max())
        fingers_m = self.agent.robot.get_qpos()[:, self.finger_columns].cpu().numpy().astype(np.float64)
        rows: list[F64] = []
        for script, at in zip(self.scripts, fingers_m, strict=True):
            tick = script[min(step, len(script) - 1)]
            finger_m = tick.finger_m
            if finger_m is None:
                finger_m = pressing_target_m(at, self.params.grip_force_n)
            rows.append(np.append(tick.arm_rad, finger_m))
        return torch.tensor(np.stack(rows), dtype=torch.float32, device=self.device)


def execute_plans(env: DatagenGraspEnv) -> torch.Tensor:
    """Reset, execute every plan to its end, and return whether each (N,) succeeded then."""
    env.reset()
    success = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
    ends = torch.tensor([len(script) for script in env.scripts], device=env.device)
    for step in range(env.plan_ticks):
        info = env.step(env.plan_action())[4]
        success = torch.where(ends == step + 1, info["success"], success)
    return success

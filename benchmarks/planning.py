"""Motion planning over whole grids: labels/s, time by stage and a configuration, and comparison with mplib.

    python -m benchmarks.planning [--houses procthor:DIR] [--objects ycb:DIR] [--scenes 12] [--quick]
    python -m benchmarks.planning --robot panda --peer PYTHON

Times are CPU seconds of this process. Grasps come from the cache if it has them, and are timed separately.
Configurations, of arm and open hand against the scene and the robot itself, lie around lines between tucked
poses, at each clear base within reach; compiled code asks for them one by one, as searches do.
With --peer, the interpreter of an environment with numpy<2 and mplib 0.1.1 plans from the same tucked poses
to the same pregrasps, among points on the surfaces of the same scenes. mplib's plan is one path with its
timing; a plan of this project is path, approach and lift, and includes the choice of the grasp.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import time
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numpy.random import Generator

from benchmarks.options import scene_options
from datagen.configuration.specify import specify
from datagen.schemas.identity import Stream, generator
from datagen.schemas.run_records import StageClock
from datagen.schemas.specification import ArmParams
from datagen.workers.bases.candidates import SceneCandidates
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import inverse, quaternion_wxyz, yaw_pose
from datagen.workers.grasps.grasp_cache import grasps_of
from datagen.workers.houses import open_houses
from datagen.workers.motion import PlanReport
from datagen.workers.motion.arm_motion import Search, is_blocked
from datagen.workers.motion.hand_motion import NOTHING
from datagen.workers.motion.plan_candidate import _Search, plan_candidate  # pyright: ignore
from datagen.workers.motion.planning_scene import PlanningScene, prepare
from datagen.workers.objects import open_objects
from datagen.workers.robots import open_robot, robot_limits
from datagen.workers.robots.resources import package_folders
from datagen.workers.scenes import Scene
from datagen.workers.scenes.generate import generate_scene
from datagen.workers.world import World, assemble_world

_POINTS = 8000  # a scene's cloud, for the peer
_RESOLUTION_M = 0.02
_CONFIGURATIONS = 100  # of a candidate


class Spent:
    """CPU seconds by stage and by outcome, and counts of outcomes."""

    def __init__(self) -> None:
        self.stage_s: dict[str, float] = defaultdict(float)
        self.outcome_s: dict[str, float] = defaultdict(float)
        self.outcomes = Counter[str]()
        self.configuration_s, self.configurations, self.blocked = 0.0, 0, 0


def main() -> None:
    """Print the tables."""
    parser = scene_options(__doc__)
    parser.add_argument("--robot", default="panda-scaled")
    parser.add_argument("--cells", type=int, default=25, help="of the grid's side")
    parser.add_argument("--quick", action="store_true", help="3 scenes with 13 x 13 candidates")
    parser.add_argument(
        "--peer", metavar="PYTHON", help="interpreter of an environment with mplib; panda alone"
    )
    parser.add_argument("--plans", type=int, default=40, help="asked of the peer")
    options = parser.parse_args()
    if options.peer and options.robot != "panda":
        parser.error("--peer compares the Panda as it is: give --robot panda")
    if options.quick:
        options.scenes, options.cells = 3, 13
    spent, problems = Spent(), []
    world = _world(options)
    for index in range(options.scenes):
        with_scene = generate_scene(world, index, StageClock())
        problems += _plan_grid(options, *with_scene, spent)
    _print_split(spent)
    if options.peer and problems:
        some = np.linspace(0, len(problems) - 1, min(options.plans, len(problems))).round().astype(int)
        _print_peer(options.peer, [problems[k] for k in some.tolist()], spent)


def _world(options: argparse.Namespace) -> World:
    houses, objects = open_houses(options.houses), open_objects(options.objects)
    fields = {
        "seed": options.seed,
        "candidates.per_scene": "grid",
        "candidates.grid_cells": options.cells,
        "candidates.robots_per_scene": 1,
    }
    spec = specify("heuristic", houses, objects, fields, None)
    return assemble_world(spec, houses, objects, options.houses, options.objects)


def _plan_grid(
    options: argparse.Namespace, scene: Scene, candidates: SceneCandidates, spent: Spent
) -> list[dict[str, Any]]:
    """Plan every candidate of a scene; return the plans found, as problems for the peer."""
    params = ArmParams()

    def measured(stage: str, start_s: float) -> None:
        spent.stage_s[stage] += time.process_time() - start_s

    start_s = time.process_time()
    limits = robot_limits(options.robot)
    reach_m = float(np.clip(candidates.arm_reach_m[0], *limits.reach_m))
    height_m = float(candidates.base_height_m[0])
    if limits.base_height_m is not None:
        height_m = float(np.clip(height_m, *limits.base_height_m))
    robot = open_robot(options.robot, reach_m, height_m)
    measured("robot", start_s)
    start_s = time.process_time()
    grasps = grasps_of(scene.models[0], robot.gripper, params.grasps)
    measured("grasps of the object", start_s)
    start_s = time.process_time()
    prepared = prepare(scene, robot, grasps, params.motion, params.grasps.per_scene, 0.25)
    measured("prepare", start_s)
    problems: list[dict[str, Any]] = []
    for row in range(len(candidates)):
        outcome = "base_collision"
        if candidates.clearance_m[row] >= 0:
            (x, y), yaw_rad = candidates.base_xy_m[row].tolist(), float(candidates.base_yaw_rad[row])
            T_world_base = yaw_pose(x, y, height_m, yaw_rad)
            start_s = time.process_time()
            outcome, report = _outcome(prepared, T_world_base, options.seed, scene, row)
            measured("plan", start_s)
            spent.outcome_s[outcome] += time.process_time() - start_s
            if outcome not in ("no_grasp", "out_of_reach"):
                _time_configurations(prepared, T_world_base, np.random.default_rng([scene.index, row]), spent)
            if report is not None and report.plan is not None and options.peer:
                T = robot.T_base_tcp(report.plan.q_reach_rad[-1])
                pose = [*T[:3, 3].tolist(), *quaternion_wxyz(T[:3, :3]).tolist()]
                start = [*robot.homes_rad[report.plan.home].tolist(), 0.04, 0.04]
                points = _surface_points(scene, T_world_base, robot.reach_m)
                problems.append({"start": start, "pose": pose, "points": points.tolist()})
        spent.outcomes[outcome] += 1
    return problems


def _outcome(
    prepared: PlanningScene, T_world_base: F64, seed: int, scene: Scene, row: int
) -> tuple[str, PlanReport | None]:
    """The outcome, including the stages before planning that cost nothing."""
    robot = prepared.robot
    if prepared.around.grasps_free == 0:
        return "no_grasp", None
    shoulder_m = T_world_base[:3, :3] @ robot.shoulder_m + T_world_base[:3, 3]
    if np.linalg.norm(prepared.around.arrays.T_world_tcp[:, :, 3] - shoulder_m, axis=1).min() > robot.reach_m:
        return "out_of_reach", None
    rng = generator(seed, Stream.PATH, scene.index, scene.retry, row)
    report = plan_candidate(prepared, T_world_base, rng)
    return report.outcome, report


def _time_configurations(prepared: PlanningScene, T_world_base: F64, rng: Generator, spent: Spent) -> None:
    robot = prepared.robot
    a, b = robot.homes_rad[rng.integers(0, len(robot.homes_rad), (2, _CONFIGURATIONS))]
    q = a + rng.uniform(size=(len(a), 1)) * (b - a) + rng.normal(0, 0.5, a.shape)
    q = np.clip(q, robot.q_lower_rad, robot.q_upper_rad)
    search = _Search(prepared, np.ascontiguousarray(T_world_base[:3]), rng).compiled
    _count_blocked(search, q[:1])  # compiled
    start_s = time.process_time()
    spent.blocked += _count_blocked(search, q)
    spent.configuration_s += time.process_time() - start_s
    spent.configurations += len(q)


@numba.njit(error_model="numpy")
def _count_blocked(search: Search, q: F64) -> int:
    count = 0
    for k in range(len(q)):
        count += is_blocked(search, q[k], 0, NOTHING)
    return count


def _surface_points(scene: Scene, T_world_base: F64, reach_m: float) -> F64:
    """Points (N, 3), base frame, spread evenly over surfaces near the arm; the target is left out."""
    rng = np.random.default_rng(0)
    corners: list[F64] = []
    house = scene.house.house
    meshes = [body.visual for body in house.bodies]
    meshes += [
        m.visual.transformed(T) for m, T in zip(scene.models[1:], scene.T_world_object[1:], strict=True)
    ]
    center_m = T_world_base[:3, 3]
    for mesh in meshes:
        triangles = mesh.vertices_m[mesh.faces].astype(np.float64)
        near = np.linalg.norm(np.clip(center_m, triangles.min(1), triangles.max(1)) - center_m, axis=1)
        corners.append(triangles[near < reach_m + 0.2])
    triangles = np.concatenate(corners)
    areas = np.linalg.norm(
        np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1
    )
    chosen = triangles[rng.choice(len(triangles), 4 * _POINTS, p=areas / areas.sum())]
    points = np.einsum("nk,nkx->nx", rng.dirichlet(np.ones(3), len(chosen)), chosen)
    points = points[np.linalg.norm(points - center_m, axis=1) < reach_m + 0.2][:_POINTS]
    T = inverse(T_world_base)
    return points @ T[:3, :3].T + T[:3, 3]


def _print_split(spent: Spent) -> None:
    labels = spent.outcomes.total()
    total_s = sum(spent.stage_s.values()) - spent.stage_s["grasps of the object"]
    print(f"{labels} labels, {labels / total_s:.0f} labels/s on one core without the grasps of the object")
    for stage, seconds in spent.stage_s.items():
        print(f"  {stage:22s} {seconds:8.2f} s  {1e3 * seconds / labels:7.3f} ms a label")
    print("outcome          candidates   share   ms each")
    for outcome, count in spent.outcomes.most_common():
        ms = 1e3 * spent.outcome_s[outcome] / count
        print(f"  {outcome:15s} {count:9d} {count / labels:7.1%} {ms:9.2f}")
    if spent.configurations:
        us = 1e6 * spent.configuration_s / spent.configurations
        share = spent.blocked / spent.configurations
        print(f"{spent.configurations:,} configurations, {share:.0%} of them blocked: {us:.2f} us each")


def _print_peer(python: str, problems: list[dict[str, Any]], spent: Spent) -> None:
    folder = next(package_folders("mani_skill")) / "assets/robots/panda"
    question = {
        "urdf": str(folder / "panda_v2.urdf"),
        "srdf": str(folder / "panda_v2.srdf"),
        "move_group": "panda_hand_tcp",
        "problems": problems,
        "resolution_m": _RESOLUTION_M,
    }
    script = Path(__file__).with_name("mplib_scene_peer.py")
    done = subprocess.run(
        [python, str(script)], input=json.dumps(question), capture_output=True, text=True, check=True
    )
    theirs = json.loads(done.stdout)
    found = spent.outcomes["success"]
    print(f"plans that were found here: {found / spent.outcome_s['success']:.0f} plans/s, whole plans")
    print(
        f"mplib, the same starts and pregrasps: {theirs['plans_per_s']:.1f} paths/s, "
        f"{theirs['solved']:.0%} of {len(problems)} found; "
        f"points of a scene take it {1e3 * theirs['points_s']:.0f} ms more"
    )


if __name__ == "__main__":
    main()

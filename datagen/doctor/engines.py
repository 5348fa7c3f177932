"""Probes of engines and robots, each in a process of its own: a crash or a hang is only a finding."""

from __future__ import annotations

import signal
import subprocess
import sys
from dataclasses import dataclass

SAPIEN_PHYSICS = """
import importlib, importlib.metadata
sapien = importlib.import_module("sapien")
scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
builder = scene.create_actor_builder()
builder.add_box_collision(half_size=[0.05, 0.05, 0.05])
builder.initial_pose = sapien.Pose([0, 0, 1])
actor = builder.build(name="cube")
scene.step()
assert actor.pose.p[2] < 1.0, "the cube does not fall"
print("sapien " + importlib.metadata.version("sapien") + ", a cube falls")
"""

PYBULLET = """
import importlib, importlib.metadata
p = importlib.import_module("pybullet")
p.connect(p.DIRECT)
p.setGravity(0, 0, -9.81)
shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.05, 0.05, 0.05])
body = p.createMultiBody(1.0, shape, basePosition=[0, 0, 1])
p.stepSimulation()
assert p.getBasePositionAndOrientation(body)[0][2] < 1.0, "the cube does not fall"
print("pybullet " + importlib.metadata.version("pybullet") + ", a cube falls")
"""

EMBREE = """
import importlib.metadata
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
scene = EmbreeScene()
TriangleMesh(scene, np.array([[[-1, -1, 0], [1, -1, 0], [0, 1, 0]]], np.float32))
origin = np.array([[0, 0, 1]], np.float32)
hit = scene.run(origin, np.array([[0, 0, -1]], np.float32))
miss = scene.run(origin, np.array([[0, 0, 1]], np.float32))
assert hit[0] == 0 and miss[0] == -1, "a ray cast has a wrong result"
print("embreex " + importlib.metadata.version("embreex") + ", a ray hits")
"""

RAY = """
import importlib
ray = importlib.import_module("ray")
print("ray " + ray.__version__)
"""
LIBRARIES = """
import importlib, importlib.metadata, importlib.util
numba = importlib.import_module("numba")
coal = importlib.import_module("coal")
assert numba.njit(lambda a, b: a + b)(1.0, 2.0) == 3.0, "machine code adds wrongly"
near, far = coal.Transform3s(), coal.Transform3s()
far.setTranslation(importlib.import_module("numpy").array([3.0, 0.0, 0.0]))
ball = coal.Sphere(1.0)
hits = lambda other: coal.collide(ball, near, ball, other, coal.CollisionRequest(), coal.CollisionResult())
assert hits(near) and not hits(far), "the collision check of two balls is wrong"
print("numba " + numba.__version__ + ", coal " + importlib.metadata.version("coal"))
"""
ROBOT = """
from datagen.workers.robots import open_robot, robot_limits
limits = robot_limits({name!r})
robot = open_robot({name!r}, limits.reach_m[1], (limits.base_height_m or (0.5,))[0])
home = robot.homes_rad[0]
assert not robot.collides_itself(home), "the first tucked pose touches itself"
hand = robot.gripper
print(f"{{len(home)}} joints, reach {{robot.reach_m:.3f}} m, hand opens {{hand.max_opening_m:.3f}} m")
"""
TRIAL = """
from datagen.doctor.lift import main
raise SystemExit(main())
"""
# Several times the usual duration: files may be read for the first time, and the cores may be busy.
_DEADLINE_S = 120.0


@dataclass(frozen=True)
class Probe:
    """The result of a probe: its last line of output, or why there is none."""

    succeeded: bool
    text: str


def probe(code: str, timeout_s: float = _DEADLINE_S) -> Probe:
    """Run Python code in a new interpreter."""
    command = [sys.executable, "-W", "ignore", "-c", code]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=timeout_s, check=False
        )
    except subprocess.TimeoutExpired:
        return Probe(False, f"no result within {timeout_s:.0f} s")
    if done.returncode < 0:
        return Probe(False, f"crashed with {signal.Signals(-done.returncode).name}")
    said = (done.stderr if done.returncode else done.stdout).strip().splitlines()
    return Probe(done.returncode == 0, said[-1][:200] if said else f"exit code {done.returncode}")

"""Checks of each engine in separate processes: one step, one ray, one frame."""

from __future__ import annotations

from datagen.doctor.check import Check, Probe, probe

_SAPIEN_PHYSICS = """
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

# Creating the render system is what fails without a device.
_SAPIEN_RENDER = """
import importlib
sapien = importlib.import_module("sapien")
system = sapien.render.RenderSystem()
print(system.device.name)
"""

_PYBULLET = """
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

_EMBREE = """
import importlib.metadata
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
scene = EmbreeScene()
TriangleMesh(scene, np.array([[[-1, -1, 0], [1, -1, 0], [0, 1, 0]]], np.float32))
origin = np.array([[0, 0, 1]], np.float32)
hit = scene.run(origin, np.array([[0, 0, -1]], np.float32))
miss = scene.run(origin, np.array([[0, 0, 1]], np.float32))
assert hit[0] == 0 and miss[0] == -1, "a ray goes astray"
print("embreex " + importlib.metadata.version("embreex") + ", a ray hits")
"""

_RAY = """
import importlib
ray = importlib.import_module("ray")
print("ray " + ray.__version__)
"""

_MESA_MEND = (
    "Only --renderer sapien needs one; on a CPU it works with Mesa 25 or newer: "
    "on Debian 12 apt-get install -t bookworm-backports mesa-vulkan-drivers"
)


def engine_checks() -> list[Check]:
    """Check settlers, renderers, the ray caster and Ray. One working settler is enough."""
    sapien, pybullet = probe(_SAPIEN_PHYSICS), probe(_PYBULLET)
    # One broken settler is a warning; without any, scenes cannot be settled.
    lost = "warn" if sapien.succeeded or pybullet.succeeded else "fail"
    embree, ray = probe(_EMBREE), probe(_RAY)
    checks = [
        sapien.check("sapien physics", lost, "See the libraries above, or use --settler pybullet."),
        pybullet.check("pybullet", lost, "Install again: make clean venv; or use --settler sapien."),
        embree.check("embree", "fail", "Install again: make clean venv."),
        ray.check("ray", "warn", "Install again: make clean venv; or use --workers 0."),
    ]
    if sapien.succeeded:
        checks.append(probe_render_device().check("sapien render device", "warn", _MESA_MEND))
    return checks


def probe_render_device() -> Probe:
    """Whether SAPIEN finds a render device; which, or why not."""
    return probe(_SAPIEN_RENDER)

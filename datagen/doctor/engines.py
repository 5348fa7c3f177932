"""Checks of each engine in separate processes: one step, one ray, one frame."""

from __future__ import annotations

from importlib.util import find_spec

from datagen.doctor.check import Check, Probe, Status, probe

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

_AGAIN = "Install it again: pip install --force-reinstall"
_MESA_FIX = (
    "Only --renderer sapien needs one; on a CPU it works with Mesa 25 or newer: "
    "on Debian 12 apt-get install -t bookworm-backports mesa-vulkan-drivers"
)


def engine_checks() -> list[Check]:
    """Check settlers, renderers, the ray caster and Ray, if installed. One working settler is enough."""
    codes = {"sapien": _SAPIEN_PHYSICS, "pybullet": _PYBULLET, "embreex": _EMBREE, "ray": _RAY}
    found = {name: probe(code) for name, code in codes.items() if find_spec(name) is not None}
    settlers = [name for name in ("sapien", "pybullet") if name in found]
    # One broken settler is a warning; without any, scenes cannot be settled.
    lost = "warn" if any(found[name].succeeded for name in settlers) else "fail"
    findings: dict[str, tuple[str, Status, str]] = {
        "sapien": ("sapien physics", lost, "Install the libraries named above, or use --settler pybullet."),
        "pybullet": ("pybullet", lost, f"{_AGAIN} pybullet; or use --settler sapien."),
        "embreex": ("embree", "fail", f"{_AGAIN} embreex"),
        "ray": ("ray", "warn", f"{_AGAIN} ray; or use --workers 0."),
    }
    checks = [answer.check(*findings[name]) for name, answer in found.items()]
    if "sapien" in found and found["sapien"].succeeded:
        checks.append(probe_render_device().check("sapien render device", "warn", _MESA_FIX))
    return checks


def probe_render_device() -> Probe:
    """Whether SAPIEN finds a render device; which, or why not."""
    return probe(_SAPIEN_RENDER)

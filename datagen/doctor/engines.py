"""Checks of engines, arms and trials in separate processes: one step, one ray, one frame, one lift."""

from __future__ import annotations

from importlib.util import find_spec

from datagen.doctor.check import Check, Probe, Status, probe
from datagen.workers.extras import EXTRAS
from datagen.workers.robots import ROBOTS, robot_limits

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

# Without a device, creating the render system fails.
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
assert hit[0] == 0 and miss[0] == -1, "a ray cast has a wrong result"
print("embreex " + importlib.metadata.version("embreex") + ", a ray hits")
"""

_RAY = """
import importlib
ray = importlib.import_module("ray")
print("ray " + ray.__version__)
"""

_AGAIN = "Install it again: pip install --force-reinstall"
_MESA_FIX = (
    "Only the renderer sapien needs one; on a CPU it works with Mesa 25 or newer: "
    "on Debian 12 apt-get install -t bookworm-backports mesa-vulkan-drivers"
)


_LIBRARIES = """
import importlib, importlib.metadata, importlib.util
pinocchio = importlib.import_module("pinocchio")
coal = importlib.import_module("coal")
model = pinocchio.buildSampleModelManipulator()
pinocchio.forwardKinematics(model, model.createData(), pinocchio.neutral(model))
near, far = coal.Transform3s(), coal.Transform3s()
far.setTranslation(importlib.import_module("numpy").array([3.0, 0.0, 0.0]))
ball = coal.Sphere(1.0)
hits = lambda other: coal.collide(ball, near, ball, other, coal.CollisionRequest(), coal.CollisionResult())
assert hits(near) and not hits(far), "the collision check of two balls is wrong"
print("pinocchio " + pinocchio.__version__ + ", coal " + importlib.metadata.version("coal"))
"""
_ROBOT = """
from datagen.workers.robots import open_robot
robot = open_robot({name!r}, {reach_m!r}, {height_m!r})
home = robot.homes_rad[0]
assert not robot.collides_itself(home), "the first tucked pose touches itself"
hand = robot.gripper
print(f"{{len(home)}} joints, reach {{robot.reach_m:.3f}} m, hand opens {{hand.max_opening_m:.3f}} m")
"""
_TRIAL = """
from datagen.doctor.lift import main
raise SystemExit(main())
"""
_ARM_AGAIN = f"{_AGAIN} pin coal mani-skill"
# Several times the usual duration: files may be read for the first time, and the cores may be busy.
_DEADLINE_S = 120.0
# Mount height for robots that allow any.
_HEIGHT_M = 0.5


def engine_checks() -> list[Check]:
    """Check settlers, renderers, the ray caster and Ray, if installed. One working settler is enough."""
    codes = {"sapien": _SAPIEN_PHYSICS, "pybullet": _PYBULLET, "embreex": _EMBREE, "ray": _RAY}
    found = {name: probe(code) for name, code in codes.items() if find_spec(name) is not None}
    settlers = [name for name in ("sapien", "pybullet") if name in found]
    # One broken settler is a warning; without any, scenes cannot be settled.
    lost = "warn" if any(found[name].succeeded for name in settlers) else "fail"
    findings: dict[str, tuple[str, Status, str]] = {
        "sapien": (
            "sapien physics",
            lost,
            "Install the libraries named above, or settle.engine pybullet.",
        ),
        "pybullet": ("pybullet", lost, f"{_AGAIN} pybullet; or settle with sapien."),
        "embreex": ("embree", "fail", f"{_AGAIN} embreex"),
        "ray": ("ray", "warn", f"{_AGAIN} ray; or use --workers 0."),
    }
    checks = [answer.check(*findings[name]) for name, answer in found.items()]
    if "sapien" in found and found["sapien"].succeeded:
        checks.append(probe_render_device().check("sapien render device", "warn", _MESA_FIX))
    return checks


def probe_render_device() -> Probe:
    """Probe for the render device of SAPIEN: its name, or why there is none."""
    return probe(_SAPIEN_RENDER)


def arm_checks() -> list[Check]:
    """Check the arm libraries, every robot of the registry, and a grasp trial.

    No check fails, because heuristic labels need none of this. Nothing is checked where the extra is not
    installed, and no robot where its libraries do not work.
    """
    if EXTRAS["sim"].missing():
        return []
    libraries = probe(_LIBRARIES, _DEADLINE_S)
    if not libraries.succeeded:
        return [Check("arm libraries", "warn", f"no plan and sim labels: {libraries.text}", _ARM_AGAIN)]
    checks = [Check("arm libraries", "ok", libraries.text)]
    for name in ROBOTS:
        limits = robot_limits(name)
        height_m = limits.base_height_m[0] if limits.base_height_m else _HEIGHT_M
        code = _ROBOT.format(name=name, reach_m=limits.reach_m[1], height_m=height_m)
        opened = probe(code, _DEADLINE_S)
        checks.append(opened.check(f"robot {name}", "warn", f"Use another --robot, or: {_ARM_AGAIN}"))
    trial = probe(_TRIAL, _DEADLINE_S)
    fix = "See `sapien physics` and the robots above; plan labels need no physics."
    checks.append(trial.check("grasp trial", "warn", fix))
    return checks

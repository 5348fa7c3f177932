"""Checks of planning and grasp trials, in separate processes: the `sim` extra."""

from __future__ import annotations

from datagen.doctor.check import Check, probe
from datagen.workers.extras import EXTRAS
from datagen.workers.robots import ROBOTS, robot_limits

_LIBRARIES = """
import importlib, importlib.metadata, importlib.util
pinocchio = importlib.import_module("pinocchio")
coal = importlib.import_module("coal")
model = pinocchio.buildSampleModelManipulator()
pinocchio.forwardKinematics(model, model.createData(), pinocchio.neutral(model))
near, far = coal.Transform3s(), coal.Transform3s()
far.setTranslation(importlib.import_module("numpy").array([3.0, 0.0, 0.0]))
ball = coal.Sphere(1.0)
ask = lambda other: coal.collide(ball, near, ball, other, coal.CollisionRequest(), coal.CollisionResult())
assert ask(near) and not ask(far), "two balls do not meet as they should"
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

_AGAIN = "Install it again: pip install --force-reinstall pin coal mani-skill"
# Several times the usual duration: files may be read for the first time, and the cores may be busy.
_DEADLINE_S = 120.0
# Mount height for robots that allow any.
_HEIGHT_M = 0.5


def arm_checks() -> list[Check]:
    """Check the arm libraries, every robot of the registry, and a grasp trial.

    No check fails, because heuristic labels need none of this. Nothing is checked where the extra is not
    installed, and no robot where its libraries do not work.
    """
    if EXTRAS["sim"].missing():
        return []
    libraries = probe(_LIBRARIES, _DEADLINE_S)
    if not libraries.succeeded:
        return [Check("arm libraries", "warn", f"no plan and sim labels: {libraries.text}", _AGAIN)]
    checks = [Check("arm libraries", "ok", libraries.text)]
    for name in ROBOTS:
        limits = robot_limits(name)
        height_m = limits.base_height_m[0] if limits.base_height_m else _HEIGHT_M
        code = _ROBOT.format(name=name, reach_m=limits.reach_m[1], height_m=height_m)
        opened = probe(code, _DEADLINE_S)
        checks.append(opened.check(f"robot {name}", "warn", f"Use another --robot, or: {_AGAIN}"))
    trial = probe(_TRIAL, _DEADLINE_S)
    fix = "See `sapien physics` and the robots above; plan labels need no physics."
    checks.append(trial.check("grasp trial", "warn", fix))
    return checks

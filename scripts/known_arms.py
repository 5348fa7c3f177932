"""Write the hands and capability maps of the registered robots, for models that score without their URDFs.

python -m scripts.known_arms [OUT]
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from datagen.train.hands.sizes import measured_hand
from datagen.workers.motion.arm_links import RADIUS, TREE
from datagen.workers.motion.measured_reach import link_spheres, measured_arm, reaches_of
from datagen.workers.motion.pose_reach import KNOWN_ARMS, PoseReach
from datagen.workers.robots import ROBOTS, gripper_of, robot_digest, robot_limits


def known_arms() -> dict[str, Any]:
    """What the file has, measured anew. A family of scaled arms has one map."""
    found: dict[str, Any] = {}
    for name in ROBOTS:
        reaches_m = reaches_of(name)
        arms = [measured_arm(name, float(reach_m)) for reach_m in reaches_m]
        assert all(np.array_equal(arm.code, arms[0].code) for arm in arms)
        found[f"{name}/digest"] = np.array(robot_digest(name) or "")
        found[f"{name}/hand"] = measured_hand(gripper_of(name))
        found[f"{name}/reach_m"] = reaches_m
        if (limits := robot_limits(name)).base_height_m and limits.footprint_m:
            found[f"{name}/base_m"] = np.array([limits.base_height_m[0], limits.base_radius_m])
            found[f"{name}/footprint_m"] = np.array(limits.footprint_m)
        found[f"{name}/size"] = np.array([size_row(arm) for arm in arms])
        found[f"{name}/code"] = arms[0].code
        tree, radius_m = link_spheres(name)
        found |= {f"{name}/{TREE}{field}": values for field, values in tree._asdict().items()}
        found[f"{name}/{RADIUS}"] = radius_m
    return found


def size_row(arm: PoseReach) -> list[float]:
    """The numbers (7,) of a map beside its codes, as `known_arm` has them."""
    return [float(arm.turns), arm.half_m, *arm.axis_xy_m.tolist(), *arm.tcp_wrist_m.tolist()]


if __name__ == "__main__":
    np.savez_compressed(sys.argv[1] if len(sys.argv) > 1 else str(KNOWN_ARMS), **known_arms())

"""`datagen robot`: open a robot's file, print what was read and derived, measure it, and draw it."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from datagen.console.options import refuse_output
from datagen.console.printing import print_rows
from datagen.workers.geometry.mesh import F64
from datagen.workers.robots import open_robot, robot_digest, robot_limits
from datagen.workers.robots.kinematic_tree import frame_poses
from datagen.workers.robots.robot import Robot

_POSES, _SEEDS = 200, 8  # of the measurement of inverse kinematics
_PEDESTAL_M = 0.8
Rows = list[tuple[str, str]]


def robot(robot: str, /, *, out: Path | None = None) -> int:
    """Open a robot's file, print what was read and what follows from it, and measure it.

    Shares are over random poses: of hand poses within reach that inverse kinematics finds from random seeds,
    and of configurations in which the robot touches itself. With --out it is drawn tucked, stretched, from
    above with its footprint and reach, and with its hand closing on a box.

    For example: datagen robot my-robot.toml --out my-robot.png

    Args:
        robot: Name of a robot, or its file ROBOT.toml.
        out: Picture to write, FILE.png.
    """
    if out is not None:
        refuse_output(out, "--out", ".png")
    began_s = time.monotonic()
    limits = robot_limits(robot)
    height_m = limits.base_height_m[0] if limits.base_height_m else _PEDESTAL_M
    opened = open_robot(robot, limits.reach_m[1], height_m)
    opened_s = time.monotonic() - began_s
    q = _random(opened)
    rows = [*robot_rows(opened), *_measures(opened, q), ("opened in", f"{opened_s:.1f} s")]
    if out is not None:
        from datagen.drawing.robot_picture import draw_robot

        draw_robot(opened, _stretched(opened, q), out)
        rows.append(("picture", str(out)))
    rows.append(("digest", robot_digest(robot) or "that of ManiSkill's version"))
    print_rows(f"robot {opened.name}", rows)
    return 0


def robot_rows(robot: Robot) -> Rows:
    """What a robot's file states and what follows from it, as names and texts."""
    keys, gripper, base = robot.source.keys, robot.gripper, robot.base
    arm = robot.assembly

    def origin(is_given: object) -> str:
        return "" if is_given else " (derived)"

    parts = sum(map(len, robot.link_parts_m))
    names = robot.link_names[robot.first_hand_link :]
    rows: Rows = [
        ("about", keys.about or "-"),
        (
            "arm",
            f"{keys.arm.base} to {keys.arm.tip}: {len(arm.arm)} joints, {len(robot.joint_names)} coordinates",
        ),
    ]
    for k, name in enumerate(robot.joint_names):
        low, high = robot.q_lower_rad[k], robot.q_upper_rad[k]
        speed, scale, unit = robot.speed_limit_radps[k], 180 / np.pi, "deg"
        if robot.slides[k]:
            scale, unit = 1.0, "m"
        text = f"{scale * low:.4g} to {scale * high:.4g} {unit}, {scale * speed:.3g} {unit}/s"
        rows.append(
            (
                "  " + " ".join(name.split("+")[:1]),
                text + (f", {name.count('+') + 1} joints" if "+" in name else ""),
            )
        )
    held = ", ".join(f"{name} {value:g}" for name, value in keys.arm.held.items())
    hand = f"{gripper.name}: {len(names)} bodies" + (f" of {keys.hand.urdf}" if keys.hand.urdf else "")
    least_m = 0.0 if gripper.linkage is None else float(gripper.linkage.opening_m[0])
    motion = "slide" if gripper.linkage is None else "turn"
    depth = gripper.pad_depth_m(np.array([least_m, gripper.max_opening_m]))
    T = arm.hand.T_palm_tcp
    x, y, z = T[:3, 3]
    rows += [
        ("held", held or "-"),
        ("reach", f"{robot.reach_m:.3f} m from {_point(robot.shoulder_m)}{origin(keys.reach_m)}"),
        ("hand", hand),
        ("fingers", f"{motion}, {100 * least_m:.1f} to {100 * gripper.max_opening_m:.1f} cm apart"),
        ("pads", f"{_mm(gripper.pad_size_m[0])} x {_mm(gripper.pad_size_m[1])} mm, at depth {_mm(depth[0])} "
                 f"(closed) to {_mm(depth[1])} mm{origin(keys.hand.pad_size_m)}"),
        ("TCP", f"({x:.3f}, {y:.3f}, {z:.3f}) m in {names[0]}, approach {_axis(T[:3, 2])}, "
                f"closing {_axis(T[:3, 1])}{origin(keys.hand.tcp)}"),
    ]  # fmt: skip
    if base.height_m is None:
        rows.append(("base", "a pedestal of any height"))
    else:
        corners = len(base.footprint_m or ())
        shape = f"{corners} corners" if corners else "a circle"
        given = keys.base.footprint_m or keys.base.radius_m
        rows += [
            ("mount", f"{base.height_m:.3f} m above the floor{origin(keys.base.height_m)}"),
            ("footprint", f"{shape} within {base.radius_m:.3f} m of the mount{origin(given)}"),
        ]
    presents = {
        "faces": "faces the target",
        "side": f"{keys.base.angle_deg:g} deg to it",
        "turns": "turns in place",
    }
    rows += [
        ("presents", presents[robot.presents]),
        ("tucked", f"{len(robot.homes_rad)} poses{origin(keys.arm.tucked)}"),
        (
            "shapes",
            f"{parts} convex parts of {len(robot.link_names)} bodies, {len(robot.self_pairs)} pairs checked",
        ),
    ]
    return rows


def _measures(robot: Robot, q: F64) -> Rows:
    rng = np.random.default_rng(1)
    touches = np.array([robot.collides_itself(row) for row in q])
    began_s, found = time.monotonic(), 0
    for row in q:
        T = robot.T_base_tcp(row)
        found += any(robot.ik(T, seed) is not None for seed in q[rng.integers(0, len(q), _SEEDS)])
    each_ms = 1000 * (time.monotonic() - began_s) / len(q)
    return [
        ("IK", f"{100 * found / len(q):.1f}% of {len(q)} poses from {_SEEDS} seeds, {each_ms:.2f} ms a pose"),
        ("touches itself", f"in {100 * touches.mean():.0f}% of {len(q)} random configurations"),
    ]


def _random(robot: Robot) -> F64:
    low, high = np.maximum(robot.q_lower_rad, -np.pi), np.minimum(robot.q_upper_rad, np.pi)
    return np.random.default_rng(0).uniform(low, high, (_POSES, len(low)))


def _stretched(robot: Robot, q: F64) -> F64:
    """The configuration whose TCP is farthest ahead, of those free of self-collision."""
    some = np.concatenate([q, np.random.default_rng(2).uniform(q.min(0), q.max(0), (4000, q.shape[1]))])
    T = frame_poses(robot.tree, some, tcp_only=True)[:, 0]
    order = np.argsort(np.abs(T[:, 1, 3]) - T[:, 0, 3])
    return next((some[k] for k in order if not robot.collides_itself(some[k])), some[order[0]])


def _mm(length_m: float) -> str:
    return f"{round(1000 * length_m)}"


def _point(p: F64) -> str:
    return f"({p[0]:.2f}, {p[1]:.2f}, {p[2]:.2f}) m around the mount"


def _axis(direction: F64) -> str:
    k = int(np.abs(direction).argmax())
    if abs(direction[k]) < 0.999:
        return "(" + ", ".join(f"{v:.2f}" for v in direction) + ")"
    return ("-" if direction[k] < 0 else "") + "xyz"[k]

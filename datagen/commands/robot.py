"""`datagen robot`: open a robot's file, print what was read and derived, measure it, and draw it."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from datagen.console.options import refuse_output
from datagen.console.printing import compiling_shown, print_rows
from datagen.workers.geometry.mesh import F64
from datagen.workers.kinematics.tree import frame_poses
from datagen.workers.robots import open_robot, robot_digest, robot_limits
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
    with compiling_shown():
        limits = robot_limits(robot)
        opened = open_robot(robot, limits.reach_m[1], (limits.base_height_m or (_PEDESTAL_M,))[0])
        opened.ik(np.eye(4), opened.homes_rad[0])  # compiled on its first call, which is not measured
    took = f"{time.monotonic() - began_s:.1f} s"
    low, high = np.maximum(opened.q_lower_rad, -np.pi), np.minimum(opened.q_upper_rad, np.pi)
    q = np.random.default_rng(0).uniform(low, high, (10 * _POSES, len(low)))
    rows = [
        *_arm(opened),
        *_hand(opened),
        *_base(opened),
        *_measures(opened, q[:_POSES]),
        ("opened in", took),
    ]
    if out is not None:
        from datagen.drawing.robot_picture import draw_robot

        draw_robot(opened, _stretched(opened, q), out)
        rows.append(("picture", str(out)))
    rows.append(("digest", robot_digest(robot) or "that of ManiSkill's version"))
    print_rows(f"robot {opened.name}", rows)
    return 0


def _origin(is_given: object) -> str:
    return "" if is_given else " (derived)"


def _arm(robot: Robot) -> Rows:
    keys, joints = robot.source.keys, robot.assembly.arm
    tip = f"{keys.arm.base} to {keys.arm.tip}"
    rows: Rows = [("arm", f"{tip}: {len(joints)} joints, {len(robot.joint_names)} coordinates")]
    for k, name in enumerate(robot.joint_names):
        unit, scale = ("m", 1.0) if robot.slides[k] else ("deg", 180 / np.pi)
        low, high, speed = scale * np.array(
            [v[k] for v in (robot.q_lower_rad, robot.q_upper_rad, robot.speed_limit_radps)]
        )
        rows.append((f"  {name.split('+')[0]}", f"{low:.4g} to {high:.4g} {unit}, {speed:.3g} {unit}/s"))
    held = ", ".join(f"{name} {value:g}" for name, value in keys.arm.held.items())
    x, y, z = robot.shoulder_m
    reach = f"{robot.reach_m:.3f} m from ({x:.2f}, {y:.2f}, {z:.2f}) m around the mount"
    return [*rows, ("held", held or "-"), ("reach", reach + _origin(keys.reach_m))]


def _hand(robot: Robot) -> Rows:
    keys, gripper, T = robot.source.keys.hand, robot.gripper, robot.assembly.hand.T_palm_tcp
    palm, *fingers = robot.link_names[robot.first_hand_link :]
    kind, least_m = "sliding", 0.0
    if gripper.linkage is not None:
        kind = "sliding" if gripper.linkage.tree.slides.all() else "turning"
        least_m = float(gripper.linkage.opening_m[0])
    shut, wide = (1000 * gripper.pad_depth_m(np.array([least_m, gripper.max_opening_m]))).round() + 0.0
    pads = " x ".join(f"{1000 * size:.0f}" for size in gripper.pad_size_m)
    x, y, z = T[:3, 3].round(3) + 0.0
    axes = f"approach {_axis(T[:3, 2])}, closing {_axis(T[:3, 1])}"
    return [
        ("hand", f"{gripper.name}: {palm} and {len(fingers)} {kind} bodies"),
        ("opening", f"{100 * least_m:.1f} to {100 * gripper.max_opening_m:.1f} cm"),
        ("pads", f"{pads} mm, at depth {shut:.0f} (closed) to {wide:.0f} mm{_origin(keys.pad_size_m)}"),
        ("TCP", f"({x}, {y}, {z}) m in {palm}, {axes}{_origin(keys.tcp)}"),
    ]


def _base(robot: Robot) -> Rows:
    keys, base = robot.source.keys, robot.base
    outline = f"{len(base.footprint_m)} corners" if base.footprint_m else "a circle"
    parts, pairs = sum(map(len, robot.link_parts_m)), len(robot.self_pairs)
    rows: Rows = [("base", "a pedestal of any height")]
    if base.height_m is not None:
        given = keys.base.footprint_m or keys.base.radius_m
        within = f"{outline} within {base.radius_m:.3f} m of the mount"
        side_deg = keys.base.side_deg or 0.0
        presents = {
            "faces": "faces the target",
            "turns": "turns in place to the target",
            "side": f"stands with the target {side_deg:g} deg from its front, counter-clockwise",
        }
        rows = [
            ("mount", f"{base.height_m:.3f} m above the floor{_origin(keys.base.height_m)}"),
            ("footprint", within + _origin(given)),
            ("base", presents[robot.presents]),
        ]
    tucked = f"{len(robot.homes_rad)} poses{_origin(keys.arm.tucked)}"
    shapes = f"{parts} convex parts of {len(robot.link_names)} bodies, {pairs} pairs checked"
    links = (link for cluster in robot.assembly.chain.clusters for link, _ in cluster.values())
    seen = [link.name for link in links if link.visuals and not link.collisions]
    named = ", ".join(seen[:4]) + (f" and {len(seen) - 4} more" if len(seen) > 4 else "")
    only = [("only seen", f"{named}: without <collision>, so of no shape to the planner")] if seen else []
    return [*rows, ("tucked", tucked), ("shapes", shapes), *only]


def _measures(robot: Robot, q: F64) -> Rows:
    rng, began_s, found = np.random.default_rng(1), time.monotonic(), 0
    for row in q:
        T, seeds = robot.T_base_tcp(row), q[rng.integers(0, len(q), _SEEDS)]
        found += any(robot.ik(T, seed) is not None for seed in seeds)
    each_ms = 1000 * (time.monotonic() - began_s) / len(q)
    touches = 100 * np.mean([robot.collides_itself(row) for row in q])
    return [
        ("IK", f"{100 * found / len(q):.1f}% of {len(q)} poses from {_SEEDS} seeds, {each_ms:.2f} ms a pose"),
        ("touches itself", f"in {touches:.0f}% of {len(q)} random configurations"),
    ]


def _stretched(robot: Robot, q: F64) -> F64:
    """The configuration whose TCP is farthest ahead, of those free of self-collision."""
    T = frame_poses(robot.tree, q, tcp_only=True)[:, 0]
    order = np.argsort(np.abs(T[:, 1, 3]) - T[:, 0, 3])
    return next((q[k] for k in order if not robot.collides_itself(q[k])), q[order[0]])


def _axis(direction: F64) -> str:
    k = int(np.abs(direction).argmax())
    if abs(direction[k]) < 0.999:
        return f"({', '.join(f'{value:.2f}' for value in direction)})"
    return ("-" if direction[k] < 0 else "") + "xyz"[k]

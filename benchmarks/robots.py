"""Robots: time to open, link poses, IK and self-collision checks a second, as tables.

    python -m benchmarks.robots [--poses 1000] [--peer PYTHON]

Times are CPU seconds of this process. `near` starts IK within about 20 degrees of a solution, `random`
anywhere within the limits; `3 seeds` tries up to three random ones for each pose until one succeeds.
Rates count failed calls too. With --peer, the interpreter of an environment with numpy<2 and
mplib==0.1.1, mplib solves the same poses of the stock Panda, free of self-collision.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import quaternion_wxyz
from datagen.workers.robots import open_robot, robot_source
from datagen.workers.robots.resources import package_folders
from datagen.workers.robots.robot import Robot

CASES = (
    ("panda", None, 0.8),
    ("panda-scaled", 0.3, 0.8),
    ("panda-scaled", 0.6, 0.8),
    ("panda-scaled", 1.0, 0.8),
    ("xarm7", None, 0.8),
    ("fetch", None, 0.726),
)
PEER_SEEDS = (1, 20)  # 20 is mplib's default
PEER_PLANS = 50


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--peer", metavar="PYTHON", help="interpreter of an environment with mplib")
    chosen = parser.parse_args()
    print(
        "robot            open ms  links/s  IK near/s solved  random/s solved  3 seeds/s solved  self/s  free"
    )
    for name, reach_m, height_m in CASES:
        _print_robot(name, reach_m, height_m, chosen.poses)
    if chosen.peer:
        _print_peer(chosen.peer, chosen.poses)


def _print_robot(name: str, reach_m: float | None, height_m: float, count: int) -> None:
    # Opened before: a process loads meshes and hulls once, not in every scene.
    robot = open_robot(name, reach_m, height_m)
    started = time.process_time()
    Robot(robot_source(name), reach_m)
    opened_ms = (time.process_time() - started) * 1e3
    rng = np.random.default_rng(0)
    q = _random(robot, rng, count)
    poses = [robot.T_base_tcp(x) for x in q]
    near = np.clip(q + rng.normal(0, 0.3, q.shape), robot.q_lower_rad, robot.q_upper_rad)
    seeds = _random(robot, rng, 3 * count).reshape(count, 3, -1)
    links, _ = _rate(robot.T_base_link, [(x,) for x in q])
    free, touches = _rate(robot.collides_itself, [(x,) for x in q])
    ik_near, found_near = _rate(robot.ik, list(zip(poses, near, strict=True)))
    ik_random, found_random = _rate(robot.ik, list(zip(poses, seeds[:, 0], strict=True)))
    calls = [0]

    def some_seed(T: F64, tries: F64) -> F64 | None:
        for seed in tries:
            calls[0] += 1
            found = robot.ik(T, seed)
            if found is not None:
                return found
        return None

    ik_three, found_three = _rate(some_seed, list(zip(poses, seeds, strict=True)))
    print(
        f"{name + (f' {reach_m} m' if reach_m else ''):<18}{opened_ms:6.0f}{links:9,.0f}"
        f"{ik_near:11,.0f}{_share(found_near):7.2f}{ik_random:10,.0f}{_share(found_random):7.2f}"
        f"{ik_three * calls[0] / count:11,.0f}{_share(found_three):7.2f}"
        f"{free:8,.0f}{1 - float(np.mean(touches)):6.2f}"
    )


def _print_peer(python: str, count: int) -> None:
    robot = open_robot("panda", None, 0.8)
    rng = np.random.default_rng(1)
    q = np.array([x for x in _random(robot, rng, 3 * count) if not robot.collides_itself(x)][:count])
    poses = [robot.T_base_tcp(x) for x in q]
    start = robot.homes_rad[0]
    folder = next(package_folders("mani_skill")) / "assets/robots/panda"
    question = {
        "urdf": str(folder / "panda_v2.urdf"),
        "srdf": str(folder / "panda_v2.srdf"),
        "move_group": "panda_hand_tcp",
        "seeds": PEER_SEEDS,
        "start": [*start, 0.04, 0.04],
        "poses": [[*T[:3, 3], *quaternion_wxyz(T[:3, :3])] for T in poses],
        "plans": PEER_PLANS,
    }
    answer: dict[str, Any] = json.loads(
        subprocess.run(
            [python, str(Path(__file__).with_name("mplib_peer.py"))],
            input=json.dumps(question),
            capture_output=True,
            text=True,
            check=True,
        ).stdout
    )
    print(f"\nStock Panda, {count} poses free of self-collision, from the first tucked pose")
    print("IK                          poses/s  solved")
    for seeds in PEER_SEEDS:
        tries = _random(robot, rng, (seeds - 1) * count).reshape(count, seeds - 1, len(start))
        tries = np.concatenate([np.broadcast_to(start, (count, 1, len(start))), tries], axis=1)
        rate, found = _rate(lambda T, s: _first_free(robot, T, s), list(zip(poses, tries, strict=True)))
        theirs = answer[f"ik_{seeds}"]
        print(f"datagen, up to {seeds:2d} seeds    {rate:10,.0f}{_share(found):8.2f}")
        print(f"mplib, {seeds:2d} seeds            {theirs['calls_per_s']:10,.0f}{theirs['solved']:8.2f}")
    plans = answer["plan"]
    print(f"mplib, IK and path          {plans['calls_per_s']:8,.1f}{plans['solved']:8.2f}")


def _first_free(robot: Robot, T: F64, seeds: F64) -> F64 | None:
    for seed in seeds:
        found = robot.ik(T, seed)
        if found is not None and not robot.collides_itself(found):
            return found
    return None


def _random(robot: Robot, rng: np.random.Generator, count: int) -> F64:
    low, high = np.maximum(robot.q_lower_rad, -np.pi), np.minimum(robot.q_upper_rad, np.pi)
    return rng.uniform(low, high, (count, len(low)))


def _rate(call: Callable[..., Any], arguments: list[tuple[Any, ...]]) -> tuple[float, list[Any]]:
    """Calls a CPU second, and what they returned."""
    started = time.process_time()
    results = [call(*values) for values in arguments]
    return len(arguments) / (time.process_time() - started), results


def _share(found: list[Any]) -> float:
    return sum(x is not None for x in found) / len(found)


if __name__ == "__main__":
    main()

"""How easily an arm brings its hand to poses, seen from many bases: look-ups in its capability map.

Maps of the registered robots are in `known_arms.npz`, so that a model scores for them without their URDFs;
`scripts/known_arms.py` writes it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F64
from datagen.workers.kinematics.compiler import compiled, in_memory, struct
from datagen.workers.kinematics.tree import Ints
from datagen.workers.motion.reach_map import (
    AZIMUTHS,
    DIRECTIONS,
    DISTANCES,
    HEIGHTS,
    ROLLS,
    ReachMap,
    cell_of,
    reach_map,
)
from datagen.workers.robots import open_largest, open_robot, robot_limits

U8 = npt.NDArray[np.uint8]

N_STAGES = 3  # the grasp, a straight way back from it, and up
WAY_M = 0.1
# Of log(1 + weighted number of samples). Codes end at a weight of 34, about four samples in a cell: more of
# them say how many solutions this arm has, in which arms of other joints differ.
CODES_PER_UNIT = 72.0
_REACH_STEP_M = 0.01
KNOWN_ARMS = files("datagen.workers.motion") / "known_arms.npz"


class PoseReach(NamedTuple):
    """Codes of a map's cells, and what finds a pose's cell. A cell of roll is half of each of two."""

    code: U8  # (C,)
    axis_xy_m: F64  # (2,)
    tcp_wrist_m: F64  # (3,)
    turns: bool
    half_m: float


struct(PoseReach)


@lru_cache(maxsize=128)
def pose_reach(name: str, reach_m: float) -> PoseReach:
    """That of a robot, by its name or file. InputError as `open_robot`.

    A scaled robot has the reach `reach_m`, to a centimetre; beyond its range it is scaled further, with its
    hand. Others have their own.
    """
    known = known_arm(name)
    reaches_m = known["reach_m"] if known else reaches_of(name)
    low, high = reaches_m[0], reaches_m[-1]
    if low == high:
        reach_m = low
    step = int(np.abs(reaches_m - reach_m).argmin())
    if known:
        turns, half_m, *row = known["size"][step].tolist()
        found = PoseReach(known["code"], np.array(row[:2]), np.array(row[2:]), bool(turns), half_m)
    else:
        found = measured_arm(name, reaches_m[step])
    more = reach_m / reaches_m[step] if not low <= reach_m <= high else 1.0
    size = {"tcp_wrist_m": found.tcp_wrist_m * more, "half_m": float(found.half_m * more)}
    return in_memory(found._replace(axis_xy_m=found.axis_xy_m * more, **size))


@lru_cache(maxsize=64)
def known_arm(name: str) -> Mapping[str, npt.NDArray[Any]]:
    """`hand` (8,), `reach_m` (L,), `size` (L, 7) at each and `code` (C,) of a registered robot; {} of others.

    The name may have the digest of its files, as in a specification: other files are another robot.
    """
    plain, _, digest = name.partition("@")
    with np.load(str(KNOWN_ARMS), allow_pickle=False) as stored:
        if f"{plain}/digest" not in stored or digest not in ("", str(stored[f"{plain}/digest"])):
            return {}
        return {field: stored[f"{plain}/{field}"] for field in ("hand", "reach_m", "size", "code")}


def reaches_of(name: str) -> F64:
    """The reaches (L,) at which a robot has maps: the ends and whole centimetres of its range, or its own."""
    low, high = robot_limits(name).reach_m
    return np.round(np.linspace(low, high, 1 + round((high - low) / _REACH_STEP_M)), 6)


def measured_arm(name: str, reach_m: float) -> PoseReach:
    """The map of a robot at one of its reaches. InputError as `open_robot`."""
    low, high = robot_limits(name).reach_m
    robot = open_largest(name) if low == high else open_robot(name, reach_m, 0.0)
    return _coded(reach_map(robot.tree.along_z()))


def size_row(arm: PoseReach) -> list[float]:
    """The numbers (7,) of a map beside its codes, as `known_arm` has them."""
    return [float(arm.turns), arm.half_m, *arm.axis_xy_m.tolist(), *arm.tcp_wrist_m.tolist()]


def _coded(reach: ReachMap) -> PoseReach:
    turns = reach.turn >= 0
    count = np.diff(reach.first).reshape(DISTANCES, HEIGHTS, -1, ROLLS, 1 if turns else AZIMUTHS)
    # Hands are often laid at multiples of 45 degrees to the horizontal, the borders of two cells of roll.
    count = count + np.roll(count, 1, axis=3)
    total = 8 * count
    for axis in (0, 1):
        there, here = [slice(None)] * 2, [slice(None)] * 2
        there[axis], here[axis] = slice(1, None), slice(None, -1)
        total[tuple(there)] += count[tuple(here)]
        total[tuple(here)] += count[tuple(there)]
    if not turns:
        total *= AZIMUTHS  # whose cells are as many times smaller
    code = np.rint(CODES_PER_UNIT * np.log1p(total)).clip(0, 255).astype(np.uint8)
    return PoseReach(code.ravel(), reach.axis_xy_m, reach.tcp_wrist_m, turns, reach.half_m)


def reach_codes(arm: PoseReach, axes: F64, pose_row: Ints, base_xy_m: F64, turn_rad: F64, rise_m: F64) -> U8:
    """Codes (N, K, N_STAGES) of K poses from each of N bases: 0 where no sample of the joints is near.

    `axes` (S, K, 3, 3) are TCP, approach and closing axis in the target's frame, zero where there is no pose;
    `pose_row` (N,) has each base's row of them. Bases are at `base_xy_m` (N, 2), target frame, their fronts
    `turn_rad` (N,) counter-clockwise from the direction to the target, their mounts `rise_m` (N,) below it.
    The better roll of the hand, whose fingers are interchangeable, counts.
    """
    found = np.zeros((len(pose_row), axes.shape[1], N_STAGES), np.uint8)
    _look_up(arm, axes, pose_row, base_xy_m, turn_rad, rise_m, found)
    return found


@compiled
def _look_up(
    arm: PoseReach, axes: F64, pose_row: Ints, base_xy_m: F64, turn_rad: F64, rise_m: F64, found: U8
) -> None:
    a, b, wrist = np.empty(3), np.empty(3), arm.tcp_wrist_m
    half_c, half_s = math.cos(math.pi / ROLLS), math.sin(math.pi / ROLLS)
    step = DIRECTIONS * ROLLS * (1 if arm.turns else AZIMUTHS)
    for n in range(len(pose_row)):
        x0, y0 = base_xy_m[n, 0], base_xy_m[n, 1]
        yaw = math.atan2(-y0, -x0) + turn_rad[n]
        c, s = math.cos(yaw), math.sin(yaw)
        for k in range(axes.shape[1]):
            tcp, approach, closing = axes[pose_row[n], k, 0], axes[pose_row[n], k, 1], axes[pose_row[n], k, 2]
            # Approach and closing axis in the base's frame, and across them.
            ax, ay, az = c * approach[0] + s * approach[1], c * approach[1] - s * approach[0], approach[2]
            bx, by, bz = c * closing[0] + s * closing[1], c * closing[1] - s * closing[0], closing[2]
            if ax * ax + ay * ay + az * az < 0.5:
                continue
            ex, ey, ez = by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax
            # The closing axis, turned by half a cell of roll.
            hx, hy, hz = half_c * bx - half_s * ex, half_c * by - half_s * ey, half_c * bz - half_s * ez
            tx, ty = tcp[0] - x0, tcp[1] - y0
            tx, ty, tz = (
                c * tx + s * ty - arm.axis_xy_m[0],
                c * ty - s * tx - arm.axis_xy_m[1],
                tcp[2] + rise_m[n],
            )
            for roll in (1.0, -1.0):
                u, v, w = roll * wrist[0], roll * wrist[1], wrist[2]
                wx, wy, wz = (
                    tx + u * ex + v * bx + w * ax,
                    ty + u * ey + v * by + w * ay,
                    tz + u * ez + v * bz + w * az,
                )
                for stage in range(3):
                    px, py, pz = wx, wy, wz
                    if stage == 1:
                        px, py, pz = wx - WAY_M * ax, wy - WAY_M * ay, wz - WAY_M * az
                    elif stage == 2:
                        pz = wz + WAY_M
                    planar = math.sqrt(px * px + py * py)
                    i, h = planar / arm.half_m * DISTANCES - 0.5, (pz / arm.half_m + 1) / 2 * HEIGHTS - 0.5
                    if not (i < DISTANCES and -1 < h < HEIGHTS):  # NaN neither
                        continue
                    # Turned to the front, as the map's samples are.
                    f, g = (px / planar, py / planar) if planar > 1e-9 else (1.0, 0.0)
                    a[0], a[1], a[2] = f * ax + g * ay, f * ay - g * ax, az
                    b[0], b[1], b[2] = roll * (f * hx + g * hy), roll * (f * hy - g * hx), roll * hz
                    azimuth = 0.0 if arm.turns else math.atan2(py, px)
                    at = cell_of(0.0, -1.0, azimuth, a, b, arm.turns)
                    ring, layer = int(math.floor(i)), int(math.floor(h))
                    value = 0.0
                    for p in range(2):
                        for q in range(2):
                            r, t = max(ring + p, 0), layer + q
                            if r < DISTANCES and 0 <= t < HEIGHTS:
                                share = (i - ring if p else ring + 1 - i) * (
                                    h - layer if q else layer + 1 - h
                                )
                                value += share * arm.code[at + (r * HEIGHTS + t) * step]
                    found[n, k, stage] = max(found[n, k, stage], int(value + 0.5))

"""How easily an arm brings its hand to poses, seen from many bases: look-ups in its capability map.

Maps of the registered robots are in `known_arms.npz`, so that a model scores for them without their URDFs;
`scripts/known_arms.py` writes it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F64
from datagen.workers.motion.reach_cells import AZIMUTHS, CELLS, DISTANCES, HEIGHTS, ROLLS, cells_of

Ints = npt.NDArray[np.int64]
U8 = npt.NDArray[np.uint8]

N_STAGES = 3  # the grasp, a straight way back from it, and up
WAY_M = 0.1
# Of log(1 + weighted number of samples). Codes end at a weight of 34, about four samples in a cell: more of
# them say how many solutions this arm has, in which arms of other joints differ.
CODES_PER_UNIT = 72.0
_AT_ONCE = 256  # bases in one pass: bounds memory
KNOWN_ARMS = files("datagen.workers.motion") / "known_arms.npz"


class PoseReach(NamedTuple):
    """Codes of a map's cells, and what finds a pose's cell. A cell of roll is half of each of two."""

    code: U8  # (C,)
    axis_xy_m: F64  # (2,)
    tcp_wrist_m: F64  # (3,)
    turns: bool
    half_m: float


@lru_cache(maxsize=128)
def pose_reach(name: str, reach_m: float) -> PoseReach:
    """That of a robot, by its name or file. InputError as `open_robot`.

    A scaled robot has the reach `reach_m`, to a centimetre; beyond its range it is scaled further, with its
    hand. Others have their own.
    """
    known = known_arm(name)
    if known:
        reaches_m = known["reach_m"]
    else:  # imported here: needs the compiler
        from datagen.workers.motion.measured_reach import reaches_of

        reaches_m = reaches_of(name)
    low, high = reaches_m[0], reaches_m[-1]
    if low == high:
        reach_m = low
    step = int(np.abs(reaches_m - reach_m).argmin())
    if known:
        turns, half_m, *row = known["size"][step].tolist()
        found = PoseReach(known["code"], np.array(row[:2]), np.array(row[2:]), bool(turns), half_m)
    else:
        from datagen.workers.motion.measured_reach import measured_arm

        found = measured_arm(name, reaches_m[step])
    more = reach_m / reaches_m[step] if not low <= reach_m <= high else 1.0
    size = {"tcp_wrist_m": found.tcp_wrist_m * more, "half_m": float(found.half_m * more)}
    return found._replace(axis_xy_m=found.axis_xy_m * more, **size)


@lru_cache(maxsize=64)
def known_arm(name: str) -> Mapping[str, npt.NDArray[Any]]:
    """`hand` (8,), `reach_m` (L,), `size` (L, 7) at each and `code` (C,) of a registered robot; {} of others.

    Fields `tree.*` and `radius_m` are those of `link_spheres`.

    The name may have the digest of its files, as in a specification: other files are another robot.
    """
    plain, _, digest = name.partition("@")
    with np.load(str(KNOWN_ARMS), allow_pickle=False) as stored:
        if f"{plain}/digest" not in stored or digest not in ("", str(stored[f"{plain}/digest"])):
            return {}
        own = f"{plain}/"
        return {field.removeprefix(own): stored[field] for field in stored.files if field.startswith(own)}


def reach_codes(arm: PoseReach, axes: F64, pose_row: Ints, base_xy_m: F64, turn_rad: F64, rise_m: F64) -> U8:
    """Codes (N, K, N_STAGES) of K poses from each of N bases: 0 where no sample of the joints is near.

    `axes` (S, K, 3, 3) are TCP, approach and closing axis in the target's frame, zero where there is no pose;
    `pose_row` (N,) has each base's row of them. Bases are at `base_xy_m` (N, 2), target frame, their fronts
    `turn_rad` (N,) counter-clockwise from the direction to the target, their mounts `rise_m` (N,) below it.
    The better roll of the hand, whose fingers are interchangeable, counts.
    """
    found = np.zeros((len(pose_row), axes.shape[1], N_STAGES), np.uint8)
    for start in range(0, len(pose_row), _AT_ONCE):
        some = slice(start, start + _AT_ONCE)
        given = (pose_row[some], base_xy_m[some], turn_rad[some], rise_m[some])
        with np.errstate(invalid="ignore"):  # poses that are not finite have no cells
            found[some] = _look_up(arm, axes, *given)
    return found


def _look_up(arm: PoseReach, axes: F64, pose_row: Ints, base_xy_m: F64, turn_rad: F64, rise_m: F64) -> U8:
    yaw = np.arctan2(-base_xy_m[:, 1], -base_xy_m[:, 0]) + turn_rad
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    tcp, approach, closing = np.moveaxis(axes[pose_row], (2, 3), (0, 1))  # (3, N, K) each

    def to_front(v: F64) -> F64:
        return np.stack([c * v[0] + s * v[1], c * v[1] - s * v[0], v[2]])

    a, b = to_front(approach), to_front(closing)
    across = np.cross(b, a, axis=0)
    # The closing axis, turned by half a cell of roll.
    half = np.pi / ROLLS
    h = np.cos(half) * b - np.sin(half) * across
    x0, y0 = base_xy_m.T[:, :, None]
    at = to_front(np.stack([tcp[0] - x0, tcp[1] - y0, tcp[2] + rise_m[:, None]]))
    at[:2] -= arm.axis_xy_m[:, None, None]
    wrist = np.array(arm.tcp_wrist_m)
    ways = np.stack([np.zeros_like(a), -WAY_M * a, WAY_M * np.eye(3)[2][:, None, None] + 0 * a])
    found = np.zeros((*a.shape[1:], N_STAGES), np.uint8)
    for roll in (1.0, -1.0):
        u, v, w = roll * wrist[0], roll * wrist[1], wrist[2]
        p = at + u * across + v * b + w * a + ways  # (N_STAGES, 3, N, K)
        values = _values(arm, p[:, 0], p[:, 1], p[:, 2], a, roll * h)
        values[:, (a * a).sum(axis=0) < 0.5] = 0.0
        found = np.maximum(found, np.moveaxis((values + 0.5).astype(np.uint8), 0, 2))
    return found


def _values(arm: PoseReach, x: F64, y: F64, z: F64, a: F64, h: F64) -> F64:
    """Codes (...) of wrists at x, y, z (...) between cells; approach a and closing axis h are (3, ...)."""
    planar = np.hypot(x, y)
    i, k = planar / arm.half_m * DISTANCES - 0.5, (z / arm.half_m + 1) / 2 * HEIGHTS - 0.5
    inside = (i < DISTANCES) & (k > -1) & (k < HEIGHTS)  # NaN neither
    i, k = np.where(inside, i, 0.0), np.where(inside, k, 0.0)
    # Turned to the front, as the map's samples are.
    safe = np.where(planar > 1e-9, planar, 1.0)
    f, g = np.where(planar > 1e-9, x / safe, 1.0), np.where(planar > 1e-9, y / safe, 0.0)
    front = [np.stack([f * v[0] + g * v[1], f * v[1] - g * v[0], v[2] + 0 * f]) for v in (a, h)]
    direction = cells_of(front[0], front[1], None if arm.turns else np.arctan2(y, x))
    ring, layer = np.floor(i).astype(np.int64), np.floor(k).astype(np.int64)
    step = CELLS * (1 if arm.turns else AZIMUTHS)
    value = np.zeros(x.shape)
    for p, r in enumerate((np.maximum(ring, 0), np.maximum(ring + 1, 0))):
        for q, t in enumerate((layer, layer + 1)):
            share = (i - ring if p else ring + 1 - i) * (k - layer if q else layer + 1 - k)
            known = inside & (r < DISTANCES) & (t >= 0) & (t < HEIGHTS)
            cell = np.where(known, direction + (r * HEIGHTS + t) * step, 0)
            value += np.where(known, share * arm.code[cell], 0.0)
    return value

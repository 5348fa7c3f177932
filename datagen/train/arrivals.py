"""Arrival error: how far a robot stops from its goal base pose, and the success expected with it.

Source of the preset `nav2`: SimpleGoalChecker of Nav2 ends a drive within xy_goal_tolerance 0.25 m and
yaw_goal_tolerance 0.25 rad by default
(docs.nav2.org/configuration/packages/nav2_controller-plugins/simple_goal_checker.html).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.special import ndtri

from datagen.schemas.errors import InputError
from datagen.train.inputs import F64, Bools

_RINGS, _ANGLES = 8, 16
_LARGEST_M = 2.0
_FIX = "Give normal:0.05 (m), normal:0.05,3deg, disc:0.25 or nav2"
_TOLERANCE_STEP_M, _TOLERANCE_MOST_M = 0.01, 0.5


@dataclass(frozen=True, eq=False)
class Arrival:
    """Equally likely errors (K, 3) at the goal: x ahead and y to the left (m), and yaw (rad).

    They are the same in all directions, so that the goal's heading does not matter.
    """

    text: str
    offsets: F64  # (K, 3)

    @property
    def yaw_std_rad(self) -> float:
        """Root mean square of the yaw errors."""
        return float(np.sqrt(np.mean(self.offsets[:, 2] ** 2)))

    @property
    def distance_m(self) -> float:
        """Root mean square distance of the arrivals from the goal."""
        return float(np.sqrt(np.mean((self.offsets[:, :2] ** 2).sum(axis=1))))

    def drawn(self, n: int, rng: np.random.Generator) -> F64:
        """`n` of the errors (n, 3), evenly spaced from a random start, so that a few still differ.

        Generators in the same state draw the same directions from rings of any size.
        """
        share = (rng.random() + np.arange(n)) / n % 1.0
        return self.offsets[np.floor(share * len(self.offsets)).astype(np.int64)]


def normal_arrival(std_m: float, yaw_std_rad: float = 0.0) -> Arrival:
    """Normal errors, with one standard deviation along x and y."""
    ring = std_m * np.sqrt(-2 * np.log1p(-_shares()))
    yaw = f", {math.degrees(yaw_std_rad):.3g} deg" if yaw_std_rad else ""
    return Arrival(f"normal, {std_m:g} m{yaw}", _round(ring, yaw_std_rad * ndtri(_yaw_shares())))


def disc_arrival(radius_m: float, yaw_rad: float = 0.0) -> Arrival:
    """Uniform errors in a disc, and uniform yaw errors up to `yaw_rad`."""
    yaw = f", {math.degrees(yaw_rad):.3g} deg" if yaw_rad else ""
    text = f"uniform within {radius_m:g} m{yaw}"
    return Arrival(text, _round(radius_m * np.sqrt(_shares()), yaw_rad * (2 * _yaw_shares() - 1)))


def ring_arrival(distance_m: float, yaw_std_rad: float = 0.0) -> Arrival:
    """Errors of exactly this distance in all directions, and normal yaw errors."""
    yaw_rad = yaw_std_rad * ndtri(_yaw_shares())
    return Arrival(f"{distance_m:g} m off", _round(np.array([distance_m]), yaw_rad))


def read_arrival(given: str) -> Arrival:
    """The arrival error of normal:STD[,YAW], disc:RADIUS[,YAW] or nav2; yaw as 3deg or in rad.

    InputError for anything else.
    """
    if given == "nav2":
        return disc_arrival(0.25, 0.25)
    kind, _, numbers = given.partition(":")
    if kind not in ("normal", "disc"):
        raise InputError("--arrival", given[:60], "is not a distribution", _FIX)
    found = re.fullmatch(r"\s*([0-9.eE+-]+)\s*(?:,\s*([0-9.eE+-]+)\s*(deg)?\s*)?", numbers, re.ASCII)
    try:
        size_m, yaw = (float(found[1]), float(found[2] or 0)) if found else (math.nan, math.nan)
    except ValueError:
        size_m = yaw = math.nan
    yaw_rad = math.radians(yaw) if found and found[3] else yaw
    if not (0 <= size_m <= _LARGEST_M and 0 <= yaw_rad <= math.pi):
        problem = f"is not a length from 0 to {_LARGEST_M:g} m and an angle"
        raise InputError("--arrival", given[:60], problem, _FIX)
    return normal_arrival(size_m, yaw_rad) if kind == "normal" else disc_arrival(size_m, yaw_rad)


def _shares() -> F64:
    return (np.arange(_RINGS) + 0.5) / _RINGS


def _yaw_shares() -> F64:
    # In an order that is independent of the directions.
    return (np.arange(_ANGLES) * 7 % _ANGLES + 0.5) / _ANGLES


def _round(rings_m: F64, yaws_rad: F64) -> F64:
    """Errors (rings * _ANGLES, 3): each ring in all directions, every second one turned by half a step."""
    step = 2 * np.pi / _ANGLES
    angle = step * (np.arange(_ANGLES) + 0.5 * (np.arange(len(rings_m)) % 2)[:, None])
    x, y = rings_m[:, None] * np.cos(angle), rings_m[:, None] * np.sin(angle)
    return np.stack([x, y, np.broadcast_to(yaws_rad, x.shape)], axis=2).reshape(-1, 3)


def expected_success(value: F64, step_m: float, arrival: Arrival) -> F64:
    """Mean (Y, X) of a map (Y, X) over the arrivals of a robot that is sent to each of its cells.

    Rows go along y and columns along x, `step_m` apart. Between cells the map is bilinear, outside it 0.
    """
    dx, dy = arrival.offsets[:, 0] / step_m, arrival.offsets[:, 1] / step_m
    n = int(np.ceil(max(np.abs(dx).max(), np.abs(dy).max()))) + 1
    kernel = np.zeros((2 * n + 1, 2 * n + 1))
    x, y = np.floor(dx).astype(int), np.floor(dy).astype(int)
    for across, up in ((0, 0), (1, 0), (0, 1), (1, 1)):
        weight = np.abs(1 - across - (dx - x)) * np.abs(1 - up - (dy - y))
        np.add.at(kernel, (y + up + n, x + across + n), weight / len(dx))
    return np.asarray(ndimage.correlate(value, kernel, mode="constant"), np.float64)


def tolerance_m(value: F64, step_m: float, cell: tuple[int, int], least: float) -> float:
    """Distance by which a robot may miss a cell (row, column) with the map (Y, X) at `least` or above.

    In any direction, in steps of 1 cm, at most 0.5 m. Between cells the map is bilinear.
    """
    far_m = np.arange(0.0, _TOLERANCE_MOST_M + 1e-9, _TOLERANCE_STEP_M)
    angle = np.linspace(0, 2 * np.pi, 4 * _ANGLES, endpoint=False)
    y = cell[0] + far_m[:, None] * np.sin(angle) / step_m
    x = cell[1] + far_m[:, None] * np.cos(angle) / step_m
    found = ndimage.map_coordinates(value, [y, x], order=1, mode="constant")
    bad = np.flatnonzero(found.min(axis=1) < least - 1e-9)
    return float(far_m[max(bad[0] - 1, 0)] if len(bad) else far_m[-1])


def stands(value: F64, can_stand: Bools) -> F64:
    """The map with 0 where the base cannot stand: an arrival there fails."""
    return np.where(can_stand, value, 0.0)

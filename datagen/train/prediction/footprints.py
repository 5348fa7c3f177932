"""The outline of a robot's base on the floor: a circle or a polygon."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from datagen.schemas.errors import InputError
from datagen.train.inputs import F64, Bools
from datagen.workers.geometry.planar import crosses_itself, distance_to_border, inside_polygon
from datagen.workers.robots import ROBOTS, robot_limits

_SMALLEST_M, _LARGEST_M = 0.02, 2.0  # limits of a base, from the mount's axis
_MOST_CORNERS = 256
_SIDES = 48  # sides of a drawn circle
_FIX = "Give a radius (0.28), corners in order (0.3,0.2;-0.3,0.2;-0.3,-0.2;0.3,-0.2) or a robot's name"


@dataclass(frozen=True)
class Footprint:
    """A base's outline in its own frame: origin on the floor below the arm's mount, x to the front.

    `corners_m` are those of a simple polygon, convex or not, in order; without corners it is the circle of
    `radius_m` around the origin. A polygon's `radius_m` is the distance of its farthest corner.
    """

    radius_m: float
    corners_m: tuple[tuple[float, float], ...] = ()

    @property
    def polygon_m(self) -> F64:
        """Its corners (K, 2); those of a circle for drawing."""
        if self.corners_m:
            return np.array(self.corners_m)
        angle = np.linspace(0, 2 * np.pi, _SIDES, endpoint=False)
        return self.radius_m * np.column_stack([np.cos(angle), np.sin(angle)])

    @property
    def middle_m(self) -> F64:
        """Middle (2,) of the polygon's bounding box: a base turns approximately about it."""
        corners = self.polygon_m
        return (corners.min(axis=0) + corners.max(axis=0)) / 2

    @property
    def turning_radius_m(self) -> float:
        """Radius of the circle around `middle_m` that holds it: the room to pass and turn anywhere."""
        if not self.corners_m:
            return self.radius_m
        return float(np.linalg.norm(self.polygon_m - self.middle_m, axis=1).max())

    @property
    def width_m(self) -> float:
        """Half of its smaller extent along its axes: the room to pass straight ahead or across."""
        return self.radius_m if not self.corners_m else float(np.ptp(self.polygon_m, axis=0).min() / 2)

    @property
    def inner_radius_m(self) -> float:
        """Radius of the largest circle around the arm's mount that it holds."""
        return distance_to_border(self.polygon_m) if self.corners_m else self.radius_m

    def holds(self, points_m: F64) -> Bools:
        """Mask (N,) of points (N, 2), in the base's frame, that lie in it."""
        if not self.corners_m:
            return np.hypot(*points_m.T) <= self.radius_m
        return inside_polygon(points_m, self.polygon_m)

    def outline(self, xy_m: F64, yaw_rad: float) -> F64:
        """Its corners (K, 2) at a base pose, world."""
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        return self.polygon_m @ np.array([[c, s], [-s, c]]) + xy_m

    def __str__(self) -> str:
        if not self.corners_m:
            return f"circle of {self.radius_m:.2f} m"
        x, y = np.ptp(self.polygon_m, axis=0)
        return f"polygon of {len(self.corners_m)} corners, {x:.2f} x {y:.2f} m"


def read_footprint(given: str | float | Sequence[Sequence[float]] | Footprint) -> Footprint:
    """A footprint of a radius (m), of corners as "x,y;x,y;..." or rows, or of a robot by its name.

    InputError for other values, and for a robot that stands on a pedestal.
    """
    if isinstance(given, Footprint):
        return given
    if not isinstance(given, str):
        return circle_footprint(given) if isinstance(given, (int, float)) else polygon_footprint(given)
    if given in ROBOTS or given.endswith(".toml"):
        limits = robot_limits(given)
        if limits.polygon_m is not None:
            return polygon_footprint(limits.polygon_m)
        if limits.base_radius_m is None:
            problem = "stands on a pedestal: its file has no base"
            raise InputError("--footprint", given, problem, "Give the radius or the corners of its base")
        return circle_footprint(limits.base_radius_m)
    try:
        rows = [[float(c) for c in corner.split(",")] for corner in given.split(";") if corner.strip()]
    except ValueError:
        raise InputError("--footprint", given[:60], "is not a footprint", _FIX) from None
    return circle_footprint(rows[0][0]) if len(rows) == 1 and len(rows[0]) == 1 else polygon_footprint(rows)


def circle_footprint(radius_m: float) -> Footprint:
    """The circle of a radius. InputError where the radius is out of range."""
    if not _SMALLEST_M <= radius_m <= _LARGEST_M:
        problem = f"has no radius from {_SMALLEST_M:g} to {_LARGEST_M:g} m"
        raise InputError("--footprint", f"{radius_m:g}", problem, _FIX)
    return Footprint(float(radius_m))


def polygon_footprint(corners_m: Sequence[Sequence[float]]) -> Footprint:
    """The polygon with these corners (x, y), in order. InputError where they outline no base."""
    try:
        corners: F64 = np.array([[float(c) for c in corner] for corner in corners_m], np.float64)
    except (TypeError, ValueError):
        corners = np.zeros((0, 2))
    if corners.ndim != 2 or corners.shape[1] != 2 or not 3 <= len(corners) <= _MOST_CORNERS:
        problem = f"is not 3 to {_MOST_CORNERS} corners of x and y"
        raise InputError("--footprint", "", problem, _FIX)
    far_m = np.abs(corners).max()
    if not (np.isfinite(corners).all() and far_m <= _LARGEST_M):
        raise InputError("--footprint", "", f"has a corner farther than {_LARGEST_M:g} m", _FIX)
    wide_m = corners.max(axis=0) - corners.min(axis=0)
    if wide_m.min() < 2 * _SMALLEST_M or crosses_itself(corners):
        raise InputError("--footprint", "", "crosses itself or has no area", _FIX)
    if not inside_polygon(np.zeros((1, 2)), corners)[0]:
        fix = "Give corners around the arm's mount: its axis is the origin, x to the front"
        raise InputError("--footprint", "", "does not hold the arm's mount", fix)
    radius_m = float(np.linalg.norm(corners, axis=1).max())
    return Footprint(radius_m, tuple((x, y) for x, y in corners.tolist()))

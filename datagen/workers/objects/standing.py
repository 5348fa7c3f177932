"""Unit and upright direction of a mesh that states neither."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

from datagen.workers.geometry.mesh import F64
from datagen.workers.objects.scan import MAX_SIZE_M

# A mesh longer than this is not in metres; up to a tenth of it, it could be in centimetres or inches.
_IN_MILLIMETRES = 20.0
# An object stands where the centre is this share of its height within the edge of what it stands on.
_MARGIN = 0.08
# y is up where the mesh rests on y = 0, and more than this share of it is below z = 0.
_AT_ZERO, _SUNK = 0.02, 0.2
_LIKELY = 0.7  # of the best chance: of a pan's two sides, the one below
_NEAR = np.cos(np.radians(10.0))
_UPS = {"z": (0, 0, 1), "-z": (0, 0, -1), "y": (0, 1, 0), "-y": (0, -1, 0), "x": (1, 0, 0), "-x": (-1, 0, 0)}


def unit_m(size: F64) -> float:
    """Metres in a unit of a mesh with these sides (3,): 0.001 for millimetres, else 1."""
    longest = float(size.max())
    return 0.001 if longest >= _IN_MILLIMETRES and longest / 1000 <= MAX_SIZE_M else 1.0


def rotation_of(up: str) -> F64:
    """The rotation (3, 3) that turns a direction, "y" or "-x", to z. Raises KeyError for another text."""
    return _turning(np.array(_UPS[up], np.float64))


def upright(points_m: F64) -> tuple[F64, str]:
    """The rotation (3, 3) that puts points (N, 3) upright, and what was done, "" for nothing.

    z stays up where the hull stands so. Else y is up, where the points rest on y = 0 or stand so, else
    the direction of the most probable rests that is nearest to z: facets below the centre, by solid angle.
    """
    hull = ConvexHull(points_m)
    corners = points_m[hull.simplices]
    points_m = points_m[hull.vertices]
    inner = points_m.mean(axis=0)
    volumes = np.abs(np.linalg.det(corners - inner))
    centre = np.average(corners.mean(axis=1) * 0.75 + inner * 0.25, axis=0, weights=volumes)
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    on_y = abs(low[1]) < _AT_ZERO * (high - low).max() and low[2] < -_SUNK * (high[2] - low[2])
    for up in ("y", "z") if on_y else ("z", "y"):
        if _stands(points_m @ rotation_of(up).T, rotation_of(up) @ centre):
            return rotation_of(up), "" if up == "z" else "y was up"
    down = hull.equations[:, :3]
    a, b, c = (corners[:, k] - centre for k in range(3))
    lengths = [np.linalg.norm(x, axis=1) for x in (a, b, c)]
    dots = [
        (x * y).sum(axis=1) * z for x, y, z in ((a, b, lengths[2]), (b, c, lengths[0]), (c, a, lengths[1]))
    ]
    angle = 2 * np.arctan2(
        np.abs(np.linalg.det(np.stack([a, b, c], axis=1))), np.prod(lengths, axis=0) + sum(dots)
    )
    below = [
        k for k in range(len(down)) if _stands(points_m @ _turning(-down[k]).T, _turning(-down[k]) @ centre)
    ]
    if not below:
        return np.eye(3), "stands on no side: z is kept up"
    chances = np.array([angle[down @ down[k] > _NEAR].sum() for k in below])
    likely = [k for k, chance in zip(below, chances, strict=True) if chance > _LIKELY * chances.max()]
    down_m = min((tuple(np.round(down[k], 6)) for k in likely), key=lambda n: (n[2], n))
    return _turning(-np.array(down_m) / np.linalg.norm(down_m)), "laid on its side"


def _stands(points_m: F64, centre: F64) -> bool:
    """Whether the centre is above what lies within 1% of the height of the lowest point, with a margin."""
    z = points_m[:, 2]
    height = float(np.ptp(z))
    feet = points_m[z <= z.min() + max(0.01 * height, 5e-4), :2]
    if len(feet) < 3 or np.linalg.matrix_rank(feet - feet[0], tol=1e-6) < 2:
        return False
    edges = ConvexHull(feet).equations
    return bool((edges[:, :2] @ centre[:2] + edges[:, 2]).max() < -_MARGIN * (centre[2] - z.min()))


def _turning(direction: F64) -> F64:
    """The shortest rotation (3, 3) that turns a unit direction to z."""
    x, y, z = direction
    if z < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    return np.array(
        [[1 - x * x / (1 + z), -x * y / (1 + z), -x], [-x * y / (1 + z), 1 - y * y / (1 + z), -y], [x, y, z]]
    )

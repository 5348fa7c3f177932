"""Centre of mass and inertia of a body made of convex parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from datagen.schemas.errors import InputError
from datagen.workers.geometry.mesh import F32, F64


@dataclass(frozen=True, eq=False)
class MassProperties:
    """Mass distribution of a body. The columns of `R_body_principal` are its principal axes."""

    centre_m: F64  # (3,), body frame
    R_body_principal: F64  # (3, 3), a rotation
    inertia_kgm2: F64  # (3,), about the centre of mass along the principal axes


def mass_properties(name: str, parts_m: Sequence[F32], mass_kg: float) -> MassProperties:
    """Properties of convex parts (each (V, 3)) of one density that together weigh `mass_kg`.

    Parts that overlap count twice where they do, as PhysX counts them. Raises InputError, naming
    the body `name` and the part, where a part has no volume.
    """
    volume_m3, first, second = 0.0, np.zeros(3), np.zeros((3, 3))
    for k, part in enumerate(parts_m):
        points = part.astype(np.float64)
        inside = points.mean(0)
        try:
            hull = ConvexHull(points)
        except QhullError as error:
            fix = "Remove the part or give it thickness"
            raise InputError(name, f"convex_parts_m[{k}]", "has no volume", fix) from error
        corners = points[hull.simplices] - inside  # (T, 3, 3): tetrahedra with `inside` as apex
        v6 = np.abs(np.linalg.det(corners))  # six times each volume
        total = corners.sum(1)
        # Moments of a tetrahedron with one corner at the origin (Tonon 2004, J. Math. Stat. 1:8).
        volume = v6.sum() / 6
        moment = np.einsum("t,ti->i", v6, total) / 24
        outer = np.einsum("t,tki,tkj->ij", v6, corners, corners) + np.einsum("t,ti,tj->ij", v6, total, total)
        volume_m3 += volume
        first += moment + volume * inside
        mixed = np.outer(moment, inside)
        second += outer / 120 + mixed + mixed.T + volume * np.outer(inside, inside)
    if volume_m3 <= 0:
        raise InputError(name, "convex_parts_m", "no part has a volume", "Give the body collision parts")
    density = mass_kg / volume_m3
    centre_m = first / volume_m3
    spread = density * (second - volume_m3 * np.outer(centre_m, centre_m))
    values, axes = np.linalg.eigh(np.trace(spread) * np.eye(3) - spread)
    if np.linalg.det(axes) < 0:
        axes[:, 2] = -axes[:, 2]
    return MassProperties(centre_m, axes, values)

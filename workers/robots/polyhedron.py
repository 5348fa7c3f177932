"""Convex parts as coal sees them."""

from __future__ import annotations

from typing import Any

import coal as _library
import numpy as np

from datagen.workers.geometry.mesh import F32, F64

# coal's module fills itself at import time, which type checkers do not see.
coal: Any = _library


def polyhedron(corners_m: F32 | F64) -> Any:
    """The solid convex hull of corners (V, 3) that span a volume."""
    points = coal.StdVec_Vec3s()
    points.extend(list(np.asarray(corners_m, np.float64)))
    return coal.ConvexBase.convexHull(points, False, "")

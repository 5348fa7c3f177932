"""Collision shapes of convex parts, each cooked once a process: cooking takes ten times as long as attaching.

SAPIEN keeps cooked hulls by the name of their file alone, so a part is written to a file for its first use.
"""

from __future__ import annotations

import hashlib
import tempfile
import warnings
from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from datagen.workers.geometry.mesh import F32
from datagen.workers.settling.sapien_bodies import convex_shape

with warnings.catch_warnings():
    # SAPIEN warns about a missing Vulkan loader at import; physics alone does not use it.
    warnings.simplefilter("ignore")
    from sapien import physx

_MOST_HULLS = 4096  # of some kilobytes each; then all are dropped
_UNSCALED = [1.0, 1.0, 1.0]
_cooked: dict[bytes, str | None] = {}  # points -> file; None where qhull makes no faces of them


def cooked_shape(part_m: F32, material: physx.PhysxMaterial) -> physx.PhysxCollisionShapeConvexMesh:
    """The hull of the points (V, 3), in the frame of the body it is attached to.

    Equal points give equal shapes, whether they were cooked before or not.
    """
    points_m = np.ascontiguousarray(part_m, np.float32)
    key = points_m.tobytes()
    if key not in _cooked:
        if len(_cooked) >= _MOST_HULLS:
            physx.clear_cache()
            _cooked.clear()
        file = f"{_folder().name}/{hashlib.sha256(key).hexdigest()}.obj"
        _cooked[key] = file if _written(file, points_m) else None
    file = _cooked[key]
    if file is None:
        return convex_shape(points_m, material)
    return physx.PhysxCollisionShapeConvexMesh(file, _UNSCALED, material)


def _written(file: str, points_m: F32) -> bool:
    """Writes the hull for SAPIEN to read once; False where qhull makes no faces of the points."""
    try:
        faces = ConvexHull(points_m.astype(np.float64)).simplices + 1
    except QhullError:
        return False
    rows = [f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in points_m.tolist()]
    rows += [f"f {a} {b} {c}\n" for a, b, c in faces.tolist()]
    Path(file).write_text("".join(rows))
    return True


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    """A folder of this process. SAPIEN looks for a hull's file also where it keeps the hull."""
    return tempfile.TemporaryDirectory(prefix="datagen-hulls-")

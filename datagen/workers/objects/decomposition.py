"""Convex parts of any surface, by CoACD in a process of its own, cached by content."""

from __future__ import annotations

import hashlib
import io
import json
import os
import subprocess
import sys

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import DAMAGED_ARRAY, DAMAGED_ZIP
from datagen.workers.content_cache import CacheFolder
from datagen.workers.extras import how_to_get, versions_of
from datagen.workers.geometry.mesh import F32
from datagen.workers.objects.hulls import distances_m, hull_of
from datagen.workers.objects.surfaces import Surface

# CoACD's defaults search ten times as long for parts that are no better.
_SETTINGS = {
    **{"threshold": 0.08, "resolution": 1000, "mcts_nodes": 10, "mcts_iterations": 20, "mcts_max_depth": 2},
    **{"max_convex_hull": 64, "seed": 1},
}
_LONGEST_S = 600.0
LATE = "has no convex parts after"
_PROGRAM = """
import ctypes, io, json, sys
if sys.platform == "linux":
    ctypes.CDLL(None).prctl(1, 9)  # PR_SET_PDEATHSIG, SIGKILL: end where the parent does
import coacd, numpy as np
given = np.load(io.BytesIO(sys.stdin.buffer.read()))
coacd.set_log_level("off")
parts = coacd.run_coacd(coacd.Mesh(given["vertices"], given["faces"]), **json.loads(sys.argv[1]))
out = io.BytesIO()
np.savez(out, *[vertices for vertices, _ in parts])
sys.stdout.buffer.write(b"PARTS" + out.getvalue())
"""
_CACHE = CacheFolder("decompositions", most_files=4096)
_SAMPLES = 2000


def decompose(surface: Surface, place: str) -> tuple[F32, ...]:
    """Vertices (V, 3) of each convex part of a surface, metres; the same on every call.

    One thread and a fixed seed; in a child, since the library aborts on some meshes. Raises InputError naming
    `place` where it fails, takes too long or is not installed.
    """
    points, at = np.unique(np.round(surface.vertices, 6), axis=0, return_inverse=True)
    faces = at.reshape(-1)[surface.faces].astype(np.int32)
    # In one order, whatever the file's: each from its lowest corner on, sorted.
    first = faces.argmin(axis=1)[:, None]
    faces = np.unique(np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1), axis=0)
    key = hashlib.sha256(json.dumps([_SETTINGS, versions_of(["coacd"])]).encode())
    key.update(points.tobytes() + faces.tobytes())
    stored = _CACHE.computed(key.hexdigest(), lambda: _run({"vertices": points, "faces": faces}, place))
    return tuple(stored[f"arr_{k}"].astype(np.float32) for k in range(len(stored)))


def _run(given: dict[str, np.ndarray], place: str) -> dict[str, np.ndarray]:
    sent, fix = io.BytesIO(), "Close and simplify the mesh, or give collision meshes"
    np.savez(sent, **given)  # pyright: ignore[reportArgumentType]
    words = [sys.executable, "-c", _PROGRAM, json.dumps(_SETTINGS)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            words, input=sent.getvalue(), capture_output=True, timeout=_LONGEST_S, env=environment, check=True
        )
        with np.load(io.BytesIO(done.stdout.partition(b"PARTS")[2])) as parts:
            return dict(parts)
    except subprocess.TimeoutExpired:
        raise InputError(place, "", f"{LATE} {_LONGEST_S:.0f} s", fix) from None
    except subprocess.CalledProcessError as error:
        if b"No module named 'coacd'" in error.stderr:
            problem = "needs coacd, as it has no collision mesh"
            raise InputError(place, "", problem, how_to_get("labels")) from None
        raise InputError(place, "", f"cannot be decomposed ({error.returncode})", fix) from None
    except (OSError, *DAMAGED_ZIP, *DAMAGED_ARRAY) as error:
        raise InputError(place, "", f"cannot be decomposed ({error})", fix) from None


def error_text(surface: Surface, parts_m: tuple[F32, ...]) -> str:
    """How far parts miss their surface: the distance that 95% of its vertices are within, and the volume."""
    hulls = [hull_of(part) for part in parts_m]
    step_m = float(np.ptp(surface.vertices, axis=0).max()) / 100
    points = surface.vertices[np.unique(surface.faces)]
    outside_m = distances_m(hulls, points[:: max(1, len(points) // _SAMPLES)], step_m)
    text = (
        f"{len(hulls)} parts, 95% of the surface within {1000 * np.percentile(outside_m, 95):.1f} mm of them"
    )
    volume_m3 = closed_volume_m3(surface)
    if volume_m3 > 0:
        text += f", volume {100 * (sum(h.volume_m3 for h in hulls) / volume_m3 - 1):+.0f}%"
    return text


def closed_volume_m3(surface: Surface) -> float:
    """The volume inside a surface, negative where it is turned inside out; 0 where it is not closed."""
    _, at = np.unique(np.round(surface.vertices, 6), axis=0, return_inverse=True)
    edges = at.reshape(-1)[surface.faces][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    edges = edges[edges[:, 0] != edges[:, 1]]
    there, back = np.unique(edges, axis=0), np.unique(edges[:, ::-1], axis=0)
    closed = len(there) == len(edges) and np.array_equal(there, back)
    corners = surface.vertices[surface.faces]
    return float(np.linalg.det(corners - corners.mean(axis=(0, 1))).sum()) / 6 if closed else 0.0

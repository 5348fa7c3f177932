"""Merging of convex parts for physics: neighbours whose common hull adds least are joined.

A scanned bowl comes with 80 parts, and the time of a physics step grows with their number.
"""

from __future__ import annotations

import hashlib
import heapq
from collections.abc import Sequence

import numpy as np
import scipy
from scipy.ndimage import map_coordinates

from datagen.workers.content_cache import Arrays, CacheFolder
from datagen.workers.geometry.mesh import F32
from datagen.workers.objects.hulls import (
    Hull,
    bounds_m,
    distances_m,
    extent_m,
    few_vertices,
    hull_of,
    surface_points_m,
)

# Part of every cache key: raise it when the same parts may be merged differently.
MERGER_VERSION = 2
# Vertices of a joined hull. PhysX accepts 255, on a GPU 64, and contacts of 64 cost half as much.
MAX_VERTICES = 64
# Number of parts that a part is paired with: those whose bounding boxes are nearest.
_NEIGHBOURS = 12
_CELLS_ACROSS = 32  # cells of the distance grid along the object's longest side
# Hulls whose errors differ by less are compared by the volume they add.
_ERROR_STEP_M = 2e-4
_CACHE = CacheFolder("hulls", most_files=4096)  # about 20 KB each
_known: dict[str, tuple[F32, ...]] = {}


def merge_parts(parts_m: Sequence[F32], limit: int) -> tuple[F32, ...]:
    """Joins convex parts, each (V, 3) with volume, until at most `limit` are left.

    Greedy: each step joins the pair whose hull protrudes least from the union of all original
    parts; among equal pairs, the one that adds least volume. A wall therefore becomes a few even
    sectors, and an opening is closed last. By volume alone, thin slivers would be joined first, even
    across the corner between a wall and its floor.

    Every original vertex lies in one of the merged parts, except those that `MAX_VERTICES` cuts off.
    If there are `limit` parts or fewer, they are returned unchanged. Otherwise the result depends
    neither on the order of the parts nor on that of their vertices. It is kept in memory and in the cache
    folder, because it takes about a second. Raises ValueError if `limit` is not positive.
    """
    if limit < 1:
        raise ValueError(f"limit {limit}: at least one part must be left")
    if len(parts_m) <= limit:
        return tuple(parts_m)
    key = _key(parts_m, limit)
    if key not in _known:
        stored = _CACHE.computed(key, lambda: _merge(parts_m, limit))
        _known[key] = tuple(np.split(stored["vertices"], stored["cuts"]))
    return _known[key]


def _merge(parts_m: Sequence[F32], limit: int) -> Arrays:
    """The vertices of the merged parts, part after part, and the rows where all but the first begin."""
    originals = sorted((hull_of(part) for part in parts_m), key=lambda hull: hull.vertices_m.tobytes())
    merged: list[F32] = []
    for group in _groups(originals, limit):
        whole = hull_of(np.concatenate([originals[k].vertices_m for k in group])).vertices_m
        few = hull_of(few_vertices(whole, MAX_VERTICES)).vertices_m if len(group) > 1 else whole
        merged.append(few.astype(np.float32))
    return {"vertices": np.concatenate(merged), "cuts": np.cumsum([len(part) for part in merged])[:-1]}


def _groups(originals: Sequence[Hull], limit: int) -> list[list[int]]:
    """`limit` groups of rows of `originals` to be joined, sorted."""
    field = _DistanceField(originals)
    alive = dict(enumerate(originals))
    groups = {k: [k] for k in alive}
    queue: list[tuple[int, float, int, int]] = []
    hulls: dict[tuple[int, int], Hull] = {}

    def add_pairs(k: int) -> None:
        for other in _nearest(alive, k):
            a, b = min(k, other), max(k, other)
            if (a, b) not in hulls:
                hull = hull_of(np.concatenate([alive[a].vertices_m, alive[b].vertices_m]))
                hulls[a, b] = hull
                added_m3 = hull.volume_m3 - alive[a].volume_m3 - alive[b].volume_m3
                heapq.heappush(queue, (round(field.reach_m(hull) / _ERROR_STEP_M), added_m3, a, b))

    for k in range(len(originals)):
        add_pairs(k)
    while len(alive) > limit:
        if not queue:  # every pair of the queue has lost one of its parts
            for k in sorted(alive):
                add_pairs(k)
        _, _, a, b = heapq.heappop(queue)
        hull = hulls.pop((a, b))
        if a not in alive or b not in alive:
            continue
        new = 2 * len(originals) - len(alive)  # one more at each step
        del alive[a], alive[b]
        alive[new] = hull
        groups[new] = sorted(groups.pop(a) + groups.pop(b))
        add_pairs(new)
    return sorted(groups.values())


def _nearest(alive: dict[int, Hull], k: int) -> list[int]:
    """The parts nearest to part `k`: by the gap between bounding boxes, then between their middles."""
    others = [other for other in alive if other != k]
    if not others:
        return []
    low = np.array([alive[other].low_m for other in others])
    high = np.array([alive[other].high_m for other in others])
    gap = np.linalg.norm(np.maximum(0, np.maximum(low - alive[k].high_m, alive[k].low_m - high)), axis=1)
    apart = np.linalg.norm((low + high) / 2 - (alive[k].low_m + alive[k].high_m) / 2, axis=1)
    return [others[row] for row in np.lexsort((others, apart, gap))[:_NEIGHBOURS]]


class _DistanceField:
    """Distance from the union of hulls, on a grid over their bounding box."""

    def __init__(self, hulls: Sequence[Hull]) -> None:
        self._cell_m = extent_m(hulls) / _CELLS_ACROSS
        self._low_m, high_m = bounds_m(hulls)
        shape = np.ceil((high_m - self._low_m) / self._cell_m).astype(int) + 1
        points = self._low_m + self._cell_m * np.indices(tuple(shape)).reshape(3, -1).T
        # In the middle of a cup all walls are equally near, which makes an unlimited search slow.
        farthest_m = extent_m(hulls) / 6
        self._distance_m = distances_m(hulls, points, self._cell_m, farthest_m).reshape(shape)

    def reach_m(self, hull: Hull) -> float:
        """Largest distance by which a hull within the bounding box protrudes from the union."""
        at = (surface_points_m(hull, self._cell_m) - self._low_m) / self._cell_m
        return float(map_coordinates(self._distance_m, at.T, order=1, mode="nearest").max())


def _key(parts_m: Sequence[F32], limit: int) -> str:
    # The parts in the order of their bytes, so that their order does not change the key.
    blobs = sorted(np.unique(np.asarray(part, np.float32), axis=0).tobytes() for part in parts_m)
    digest = hashlib.sha256(f"{MERGER_VERSION} {scipy.__version__} {limit}".encode())
    for blob in blobs:
        digest.update(hashlib.sha256(blob).digest())
    return digest.hexdigest()

"""Settled scenes at every kind of place, checked by exact distances of another library.

    python -m benchmarks.resting [--houses procthor:DIR] [--objects ycb:DIR] [--scenes 90]

Needs coal. `--scenes` scenes of each kind of place with 0 to 14 objects are settled as in a run. A row has
each object's smallest signed distance to all that surrounds it: the deepest overlap, the largest gap (an
object that floats), and how many objects are deeper than 1 mm or float above 3 mm. Then redraws by cause.
"""

from __future__ import annotations

from collections import Counter
from functools import lru_cache
from importlib import import_module
from itertools import chain
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.options import scene_options
from datagen.configuration.specify import specify
from datagen.schemas.run_records import StageClock
from datagen.schemas.specification import PLACE_KINDS
from datagen.workers.geometry.mesh import F64
from datagen.workers.houses import open_houses
from datagen.workers.objects import open_objects
from datagen.workers.robots.hulls import polyhedron
from datagen.workers.scenes import Scene
from datagen.workers.scenes.generate import generate_scene
from datagen.workers.world import assemble_world

coal: Any = import_module("coal")  # without types
_NEAR_M = 0.02
_DEEP_M, _FLOATS_M = 0.001, 0.003


def main() -> None:
    """Print the table."""
    options = scene_options(__doc__).parse_args()
    houses, objects = open_houses(options.houses), open_objects(options.objects)
    redraws: Counter[str] = Counter()
    print(f"{'place':8}{'scenes':>8}{'objects':>9}{'deepest mm':>12}{'> 1 mm':>8}{'gap mm':>9}{'> 3 mm':>8}")
    for kind in PLACE_KINDS:
        fields: dict[str, Any] = {
            "seed": options.seed,
            f"scene.places.{kind}": 1.0,
            "scene.n_clutter": 14,
            "candidates.within": "clear",
            "candidates.per_scene": 4,
            "candidates.robots_per_scene": 1,
        }
        spec = specify("heuristic", houses, objects, fields, None)
        world = assemble_world(spec, houses, objects, options.houses, options.objects)
        gaps: list[F64] = []
        for index in range(options.scenes):
            scene, _ = generate_scene(world, index, StageClock())
            redraws.update(scene.redraws)
            gaps.append(gaps_of(scene))
        m = np.concatenate(gaps)
        print(
            f"{kind:8}{len(gaps):8}{len(m):9}{-1000 * m.min():12.2f}{(m < -_DEEP_M).sum():8}"
            f"{1000 * m.max():9.2f}{(m > _FLOATS_M).sum():8}",
            flush=True,
        )
    print("redraws: " + ", ".join(f"{cause} {count}" for cause, count in redraws.most_common()))


def gaps_of(scene: Scene) -> F64:
    """Smallest signed distance (K,) of each object to the house and the other objects."""
    moved = [
        [(part @ T[:3, :3].T + T[:3, 3]).astype(np.float64) for part in model.convex_parts_m]
        for model, T in zip(scene.models, scene.T_world_object, strict=True)
    ]
    parts = [*(part.astype(np.float64) for part in scene.house.house.parts_m), *chain(*moved)]
    owner = np.concatenate([np.full(len(parts) - sum(map(len, moved)), -1), *map(_numbers, enumerate(moved))])
    low, high = np.array([p.min(0) for p in parts]), np.array([p.max(0) for p in parts])
    shape = lru_cache(maxsize=None)(lambda k: polyhedron(parts[k]))
    gaps = np.full(len(moved), np.inf)
    still = coal.Transform3s()
    for own in np.flatnonzero(owner >= 0).tolist():
        near = ((low <= high[own] + _NEAR_M) & (high >= low[own] - _NEAR_M)).all(1) & (owner != owner[own])
        for other in np.flatnonzero(near).tolist():
            ask, result = coal.DistanceRequest(), coal.DistanceResult()
            gap_m = coal.distance(shape(own), still, shape(other), still, ask, result)
            gaps[owner[own]] = min(gaps[owner[own]], gap_m)
    return gaps


def _numbers(of: tuple[int, list[F64]]) -> npt.NDArray[np.int64]:
    return np.full(len(of[1]), of[0])


if __name__ == "__main__":
    main()

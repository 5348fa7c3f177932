"""Why bases do not fit: the candidates of a run with outcome `base_collision`, by cause.

    python -m benchmarks.base_collisions RUN [--scenes 20]

Each counts once, under the first cause that applies: outside all rooms; in another room than the target's;
with its middle in a wall, in the furniture that carries the target, or in other furniture; or with
its middle on free floor, but nearer than the base's radius to one of these. A second table says how many
would fit, and how many of these within reach, were the base narrower.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from datagen.schemas.run import Run
from datagen.schemas.shard_reading import read_scene
from datagen.schemas.specification import CandidateParams
from datagen.workers.bases.clearance import STEP_M, base_clearance_m
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.planar import (
    convex_hull,
    inside_any,
    signed_distances_to_convex,
    stack_polygons,
)
from datagen.workers.houses.house import House
from datagen.workers.world import PreparedHouse, open_world

RADII_M = (0.25, 0.2, 0.15, 0.1, 0.05)
_IN_THE_WAY = ("a wall", "the furniture with the target", "other furniture")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", metavar="RUN", help="a run over whole grids")
    parser.add_argument("--scenes", type=int, default=20)
    options = parser.parse_args()
    run = Run.open(options.run)
    spec, sources = run.manifest.spec, run.manifest.sources
    world = open_world(spec, sources.get("houses", "builtin"), sources.get("objects", "builtin"))
    counts: Counter[str] = Counter()
    blocked, near = np.zeros(len(RADII_M), np.int64), np.zeros(len(RADII_M), np.int64)
    for index in range(options.scenes):
        rows = read_scene(run, index)
        house = world.house(str(rows.record["house_id"]))
        counts.update(causes(house.house, rows.record, rows.samples))
        free_m = [cleared(house, rows.samples, spec.candidates, radius_m) for radius_m in RADII_M]
        fits = np.stack(free_m) >= 0
        blocked += (~fits).sum(1)
        near += (fits & (rows.samples["mount_distance_m"] <= rows.samples["arm_reach_m"])).sum(1)
    print_shares(counts, options.scenes)
    total = counts.total()
    print(f"\n{'base radius m':36}" + "".join(f"{radius_m:>8g}" for radius_m in RADII_M))
    print(f"{'bases that do not fit':36}" + "".join(f"{100 * n / total:7.1f}%" for n in blocked))
    print(f"{'bases that fit, within reach':36}" + "".join(f"{100 * n / total:7.1f}%" for n in near))


def causes(house: House, record: Mapping[str, Any], samples: Mapping[str, np.ndarray[Any, Any]]) -> list[str]:
    """The cause of each candidate's collision; "clear" where the base fits."""
    xy = samples["base_xy_m"].astype(np.float64)
    room = house.room(str(record["room_id"]))
    indoors = inside_any(xy, [r.polygon_m for r in house.rooms])
    is_in_room = inside_any(xy, [room.polygon_m])
    depth_m = np.stack([gaps(house, str(record["support_id"]), kind, xy, samples) for kind in _IN_THE_WAY])
    found: list[str] = []
    for k, fits in enumerate(samples["base_clearance_m"] >= 0):
        nearest = _IN_THE_WAY[int(depth_m[:, k].argmin())]
        if fits:
            found.append("clear")
        elif not indoors[k]:
            found.append("outside all rooms")
        elif not is_in_room[k]:
            found.append("in another room")
        elif depth_m[:, k].min() < 0:
            found.append(f"middle in {nearest}")
        else:
            found.append(f"too near to {nearest}")
    return found


def gaps(
    house: House, support_id: str, kind: str, xy: F64, samples: Mapping[str, np.ndarray[Any, Any]]
) -> F64:
    """Distance (N,) of bases' middles from footprints of a kind that begin below the mount."""
    surface = next(s for s in house.surfaces if s.surface_id == support_id)

    def is_of_kind(body_id: str, body_kind: str) -> bool:
        if body_kind == "wall" or kind == "a wall":
            return body_kind == "wall" and kind == "a wall"
        return (body_id == surface.body_id) == (kind == "the furniture with the target")

    parts = [
        part
        for body in house.bodies
        if is_of_kind(body.body_id, body.kind)
        for part in body.convex_parts_m
        if part[:, 2].max() > STEP_M
    ]
    if not parts:
        return np.full(len(xy), np.inf)
    polygons = stack_polygons([convex_hull(p[:, :2].astype(np.float64)) for p in parts])
    low_m = np.array([p[:, 2].min() for p in parts])
    distance = signed_distances_to_convex(xy, polygons)
    return np.where(low_m < samples["base_height_m"][:, None], distance, np.inf).min(1)


def cleared(
    house: PreparedHouse,
    samples: Mapping[str, np.ndarray[Any, Any]],
    params: CandidateParams,
    radius_m: float,
) -> np.ndarray[Any, Any]:
    """Clearances (N,) with a base of another radius."""
    heights = (samples["base_height_m"], samples["camera_height_m"])
    radii_m = np.full(len(samples["base_xy_m"]), radius_m)
    return base_clearance_m(samples["base_xy_m"], *heights, radii_m, house.obstacles, params.mast_radius_m)


def print_shares(counts: Counter[str], scenes: int) -> None:
    """Counts and shares of all candidates."""
    total = counts.total()
    print(f"{total:,} candidates of {scenes} scenes")
    for cause, count in counts.most_common():
        print(f"{cause:44}{count:7,}{100 * count / total:7.1f}%")


if __name__ == "__main__":
    main()

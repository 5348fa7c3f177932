"""Visibility labels by Embree against a labeller on pybullet's TinyRenderer, as a table.

    python -m benchmarks.visibility [--houses procthor:DIR] [--objects ycb:DIR] [--scenes 12] [--quick]

Both look at the same settled scenes from the same eyes through the same 64 x 64 window. Times are CPU
seconds of this process. Loading is what each needs before the first look at a scene: hierarchies
for Embree (a run keeps those of objects; here all are built anew), vertex buffers for Bullet.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np

from datagen.specify import specify
from schemas.cost import StageClock
from schemas.identity import Stream, generator
from workers.bases.candidates import draw_candidates
from workers.bases.clearance import Obstacles, base_clearance_m
from workers.geometry.mesh import F64
from workers.geometry.planar import signed_distances_to_convex
from workers.houses import open_houses
from workers.objects import open_objects
from workers.rendering.embree_renderer import ray_stage
from workers.rendering.frame import Stage
from workers.rendering.pybullet_renderer import PybulletStage
from workers.rendering.visibility import visible_pixels
from workers.scenes.draw import draw_scene
from workers.world import assemble_world

TARGET_RATIO, TARGET_DIFFERENCE = 20.0, 0.02
EDGES = (0.0, 1e-9, 3e-4, 1e-3, 3e-3, 0.01, 0.02, 0.05, 0.2, 1.0)


@dataclass
class Spent:
    """CPU seconds of one labeller."""

    load_s: float = 0.0
    look_s: float = 0.0

    @property
    def total_s(self) -> float:
        return self.load_s + self.look_s


@dataclass(frozen=True, eq=False)
class Looks:
    """One row a candidate, over all scenes."""

    rho: F64  # (N, 2), by Embree and by TinyRenderer
    target_px: F64  # (N, 2), of the target alone
    clear: np.ndarray  # (N,), the base fits there
    buried: np.ndarray  # (N,), the eye lies within furniture, a wall or a thing


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--houses", default="builtin")
    parser.add_argument("--objects", default="builtin")
    parser.add_argument("--scenes", type=int, default=12)
    parser.add_argument("--candidates", type=int, default=60, help="a scene")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true", help="3 scenes with 20 candidates")
    options = parser.parse_args()
    if options.quick:
        options.scenes, options.candidates = 3, 20
    looks, embree, tiny = look(options)
    print_speed(len(looks.rho), options.scenes, embree, tiny)
    print_agreement(looks)


def look(options: argparse.Namespace) -> tuple[Looks, Spent, Spent]:
    """rho of every candidate by both labellers, and what each spent."""
    houses, objects = open_houses(options.houses), open_objects(options.objects)
    fields = {"seed": options.seed, "candidates.per_scene": options.candidates}
    spec = specify("heuristic", houses, objects, fields, None)
    world = assemble_world(spec, houses, objects, options.houses, options.objects)
    window = spec.visibility.window_px
    embree, tiny = Spent(), Spent()
    rho, target_px, clear, buried = [], [], [], []
    for index in range(options.scenes):
        scene = draw_scene(world, index, StageClock())
        rng = generator(spec.seed, Stream.CANDIDATES, index, scene.retry)
        candidates = draw_candidates(scene.target_center_m, spec.candidates, rng)
        eyes_m = np.column_stack([candidates.base_xy_m, candidates.camera_height_m]).astype(np.float64)
        stage = Stage(scene.house.house, scene.models, scene.T_world_object)

        started_s = time.process_time()
        rays = ray_stage(stage)
        loaded_s = time.process_time()
        by_embree = visible_pixels(rays, 0, eyes_m, window)
        embree.load_s += loaded_s - started_s
        embree.look_s += time.process_time() - loaded_s

        started_s = time.process_time()
        with PybulletStage(stage) as loaded:
            loaded.visible_pixels(0, eyes_m[:0], window)  # loads the target alone
            loaded_s = time.process_time()
            by_tiny = loaded.visible_pixels(0, eyes_m, window)
            tiny.look_s += time.process_time() - loaded_s
        tiny.load_s += loaded_s - started_s

        both = np.array([by_embree, by_tiny], np.float64)  # (2 labellers, 2 counts, N)
        rho.append((both[:, 1] / np.maximum(both[:, 0], 1)).T)
        target_px.append(both[:, 0].T)
        clear.append(base_clearance_m(candidates, scene.house.obstacles, spec.candidates) >= 0)
        buried.append(within_solids(eyes_m, scene.house.obstacles))
    joined = (np.concatenate(rows) for rows in (rho, target_px, clear, buried))
    return Looks(*joined), embree, tiny


def within_solids(eyes_m: F64, obstacles: Obstacles) -> np.ndarray:
    """Whether each eye (N, 3) lies over the footprint of a part and between its bottom and top."""
    over = signed_distances_to_convex(eyes_m[:, :2], obstacles.polygons_m) < 0  # (N, P)
    height_m = eyes_m[:, 2:]
    return (over & (height_m > obstacles.low_m) & (height_m < obstacles.high_m)).any(1)


def print_speed(labels: int, scenes: int, embree: Spent, tiny: Spent) -> None:
    """Rates of both labellers and their ratio."""
    print(f"{labels} candidates in {scenes} scenes, CPU time of one core")
    print(f"{'':<24} {'Embree':>10} {'TinyRenderer':>13} {'ratio':>7}")
    print(
        f"{'loading, ms/scene':<24} {1e3 * embree.load_s / scenes:>10.1f} {1e3 * tiny.load_s / scenes:>13.1f}"
        f" {tiny.load_s / embree.load_s:>7.1f}"
    )
    for name, ours_s, theirs_s in (
        ("labels/s, looking alone", embree.look_s, tiny.look_s),
        ("labels/s with loading", embree.total_s, tiny.total_s),
    ):
        ratio = theirs_s / ours_s
        print(f"{name:<24} {labels / ours_s:>10,.0f} {labels / theirs_s:>13,.1f} {ratio:>7.1f}", end="")
        print(f"  (at least {TARGET_RATIO:g}: {verdict(ratio >= TARGET_RATIO)})")


def print_agreement(looks: Looks) -> None:
    """Mean absolute difference of rho and its histogram, by kind of candidate."""
    difference = np.abs(looks.rho[:, 0] - looks.rho[:, 1])
    seen = (looks.target_px > 0).all(1)
    groups = {
        "all": np.ones(len(difference), bool),
        "clear": looks.clear,
        "eye in the open": ~looks.buried,
        "eye within a solid": looks.buried,
    }
    print("\n|rho by Embree - rho by TinyRenderer|")
    print(f"{'candidates':<20} {'number':>7} {'mean':>8} {'95%':>8} {'largest':>8}")
    for name, rows in groups.items():
        d = difference[rows]
        if not len(d):
            print(f"{name:<20} {0:>7}")
            continue
        line = f"{name:<20} {len(d):>7} {d.mean():>8.4f} {np.quantile(d, 0.95):>8.4f} {d.max():>8.4f}"
        aim = f"  (at most {TARGET_DIFFERENCE:g}: {verdict(d.mean() <= TARGET_DIFFERENCE)})"
        print(line + (aim if name in ("all", "clear") else ""))
    relative = looks.target_px[seen, 1] / looks.target_px[seen, 0] - 1
    print(f"pixels of the target alone: TinyRenderer counts {100 * relative.mean():+.2f}% on average")
    print("\nhistogram of the difference, share of candidates")
    print(f"{'from':>7} {'below':>7} {'all':>7} {'clear':>7}")
    counts = [np.histogram(difference[rows], EDGES)[0] / max(1, rows.sum()) for rows in
              (groups["all"], groups["clear"])]  # fmt: skip
    for low, high, of_all, of_clear in zip(EDGES, EDGES[1:], *counts, strict=False):
        print(f"{low:>7g} {high:>7g} {100 * of_all:>6.1f}% {100 * of_clear:>6.1f}%")


def verdict(reached: bool) -> str:
    """How a figure stands to its target."""
    return "reached" if reached else "MISSED"


if __name__ == "__main__":
    main()

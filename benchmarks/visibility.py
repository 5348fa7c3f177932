"""Visibility labels by Embree against a labeller on pybullet's TinyRenderer, as a table.

    python -m benchmarks.visibility [--houses procthor:DIR] [--objects ycb:DIR] [--scenes 12] [--quick]

Both render the same settled scenes from the same eyes through the same 64 x 64 window. Times are CPU
seconds of this process. Loading is the work before the first view of a scene: hierarchies for Embree,
vertex buffers and textures for Bullet. It is timed for everything, and for the house alone, as in a run,
which keeps its objects.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np

from benchmarks.options import scene_options
from datagen.configuration.specify import specify
from datagen.schemas.run_records import StageClock
from datagen.workers.geometry.mesh import F64
from datagen.workers.houses import open_houses
from datagen.workers.objects import open_objects
from datagen.workers.rendering import SceneGeometry
from datagen.workers.rendering.embree import RayScene, first_hits, into_frame, ray_scene
from datagen.workers.rendering.visibility import visible_pixels
from datagen.workers.scenes.generate import generate_scene
from datagen.workers.world import assemble_world
from tests.workers.rendering.pybullet_visibility import PybulletScene

TARGET_RATIO, TARGET_DIFFERENCE = 20.0, 0.02
NEAR_M = 0.025  # a rasteriser's usual near plane, and a little more for rays off the middle
EDGES = (0.0, 1e-9, 3e-4, 1e-3, 3e-3, 0.01, 0.02, 0.05, 0.2, 1.0)


@dataclass
class Spent:
    """CPU seconds of one labeller."""

    load_s: float = 0.0  # everything
    house_s: float = 0.0  # the house alone
    look_s: float = 0.0


@dataclass(frozen=True, eq=False)
class Looks:
    """One row a candidate, over all scenes."""

    rho: F64  # (N, 2), by Embree and by TinyRenderer
    target_px: F64  # (N, 2), of the target alone
    clear: np.ndarray  # (N,), the base fits there
    in_surface: np.ndarray  # (N,), the eye is in, or right at, a wall, furniture or an object


def main() -> None:
    """Print the tables."""
    parser = scene_options(__doc__)
    parser.add_argument("--candidates", type=int, default=60, help="a scene")
    parser.add_argument("--quick", action="store_true", help="3 scenes with 20 candidates")
    options = parser.parse_args()
    if options.quick:
        options.scenes, options.candidates = 3, 20
    looks, embree, tiny = look(options)
    print_speed(len(looks.rho), options.scenes, embree, tiny)
    print_agreement(looks)


def look(options: argparse.Namespace) -> tuple[Looks, Spent, Spent]:
    """rho of every candidate by both labellers, and the CPU seconds of each."""
    houses, objects = open_houses(options.houses), open_objects(options.objects)
    fields = {"seed": options.seed, "candidates.per_scene": options.candidates}
    spec = specify("heuristic", houses, objects, fields, None)
    world = assemble_world(spec, houses, objects, options.houses, options.objects)
    window = spec.visibility.window_px
    embree, tiny = Spent(), Spent()
    rho, target_px, clear, in_surface = [], [], [], []
    for index in range(options.scenes):
        scene, candidates = generate_scene(world, index, StageClock())
        eyes_m = np.column_stack([candidates.base_xy_m, candidates.camera_height_m]).astype(np.float64)
        stage = SceneGeometry(scene.house.house, scene.models, scene.T_world_object)

        bare = SceneGeometry(scene.house.house, (), np.zeros((0, 4, 4)))
        started_s = time.process_time()
        ray_scene(bare)
        embree.house_s += time.process_time() - started_s
        started_s = time.process_time()
        with PybulletScene(bare):
            tiny.house_s += time.process_time() - started_s

        started_s = time.process_time()
        rays = ray_scene(stage)
        loaded_s = time.process_time()
        by_embree = visible_pixels(rays, 0, eyes_m, window)
        embree.load_s += loaded_s - started_s
        embree.look_s += time.process_time() - loaded_s

        started_s = time.process_time()
        with PybulletScene(stage) as loaded:
            loaded.visible_pixels(0, eyes_m[:0], window)  # loads the target alone
            loaded_s = time.process_time()
            by_tiny = loaded.visible_pixels(0, eyes_m, window)
            tiny.look_s += time.process_time() - loaded_s
        tiny.load_s += loaded_s - started_s

        both = np.array([by_embree, by_tiny], np.float64)  # (2 labellers, 2 counts, N)
        rho.append((both[:, 1] / np.maximum(both[:, 0], 1)).T)
        target_px.append(both[:, 0].T)
        clear.append(candidates.clearance_m >= 0)
        in_surface.append(stand_in_surfaces(scene.rays, eyes_m))
    joined = (np.concatenate(rows) for rows in (rho, target_px, clear, in_surface))
    return Looks(*joined), embree, tiny


def stand_in_surfaces(rays: RayScene, eyes_m: F64) -> np.ndarray:
    """Whether the first surface before each eye (N, 3) is seen from behind or nearer than NEAR_M.

    There a rasteriser is easily wrong: where it leaves out back faces, or surfaces before its near plane, an
    eye within a wall looks through it. For rays the wall still hides the target.
    """
    centre_m = rays.T_world_object[0, :3, 3]
    distance_m = np.linalg.norm(centre_m - eyes_m, axis=1)
    towards = ((centre_m - eyes_m) / distance_m[:, None]).astype(np.float32)
    first_m, behind = distance_m.copy(), np.zeros(len(eyes_m), bool)
    bodies = [(rays.house, np.eye(4)), *zip(rays.objects[1:], rays.T_world_object[1:], strict=True)]
    for body, T_world_body in bodies:
        origins, directions = into_frame(T_world_body, eyes_m.astype(np.float32), towards)
        hits = first_hits(body, origins, directions)
        first = (hits.face >= 0) & (hits.parameter < first_m)
        from_behind = np.einsum("ij,ij->i", body.normals[hits.face], directions) > 0
        first_m, behind = np.where(first, hits.parameter, first_m), np.where(first, from_behind, behind)
    return behind | (first_m < NEAR_M)


def print_speed(labels: int, scenes: int, embree: Spent, tiny: Spent) -> None:
    """Rates of both labellers and their ratio."""
    print(f"{labels} candidates in {scenes} scenes, CPU time of one core")
    print(f"{'':<24} {'Embree':>10} {'TinyRenderer':>13} {'ratio':>7}")
    for name, ours_s, theirs_s in (
        ("loading all, ms/scene", embree.load_s, tiny.load_s),
        ("loading house, ms/scene", embree.house_s, tiny.house_s),
    ):
        ours_ms, theirs_ms = 1e3 * ours_s / scenes, 1e3 * theirs_s / scenes
        print(f"{name:<24} {ours_ms:>10.1f} {theirs_ms:>13.1f} {theirs_ms / ours_ms:>7.1f}")
    # The target ratio is for loading as in a run, which does not build every object again for each scene.
    for name, ours_s, theirs_s, judged in (
        ("labels/s, looking alone", embree.look_s, tiny.look_s, True),
        ("  loading the house", embree.look_s + embree.house_s, tiny.look_s + tiny.house_s, True),
        ("  loading everything", embree.look_s + embree.load_s, tiny.look_s + tiny.load_s, False),
    ):
        ratio = theirs_s / ours_s
        aim = f"  (at least {TARGET_RATIO:g}: {verdict(ratio >= TARGET_RATIO)})" if judged else ""
        print(f"{name:<24} {labels / ours_s:>10,.0f} {labels / theirs_s:>13,.1f} {ratio:>7.1f}{aim}")


def print_agreement(looks: Looks) -> None:
    """Mean absolute difference of rho and its histogram, by kind of candidate."""
    difference = np.abs(looks.rho[:, 0] - looks.rho[:, 1])
    seen = (looks.target_px > 0).all(1)
    groups = {
        "all": np.ones(len(difference), bool),
        "clear": looks.clear,
        "eye in the open": ~looks.in_surface,
        "eye in a surface": looks.in_surface,
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
    """Whether a figure reached its target, in words."""
    return "reached" if reached else "MISSED"


if __name__ == "__main__":
    main()

"""What limits picks of base poses: the view, or labels that repeat; as a table.

    python -m benchmarks.pick_shares RUN --houses procthor:DIR --objects ycb:DIR [--draws 2] [--views 2]

Clear candidates within reach of scenes of a `plan` run of whole grids that have a good one. Each is labelled
again under other draws of grasps, seeds and paths (`benchmarks.repeatability`), and each scene is observed
from other viewpoints, from fewer where no other place sees the target. A row is a way to pick one candidate
of a scene; columns are how often it is good by the stored labels and on average by the other draws. "Labels
of a draw" picks by labels that know the whole scene: of the good candidates of another draw the one nearest
to 0.75 of the reach, judged by the others.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.repeatability import Labelling, label_scene, stored_scenes, within_reach
from datagen.schemas.run import Run
from datagen.schemas.specification import DECISIVE_SHARES, ObservationParams, Specification
from datagen.train.dataset import SampleStream
from datagen.train.inputs import I64, Array, Clouds
from datagen.train.prediction import load_scorer
from datagen.workers.rendering.cloud import Cloud, observe_cloud, stored_cloud
from datagen.workers.rendering.embree import cast_pixels
from datagen.workers.scenes.generate import draw_viewpoint
from datagen.workers.scenes.placement import SceneRejected
from datagen.workers.scenes.reconstruct import ReconstructedScene, reconstruct_candidates, reconstruct_scene
from datagen.workers.world import open_world

_SHARE = 0.75  # of the reach
_TARGET_POINTS = 256  # of the target in a fused cloud
_SEED = 0


def main() -> None:
    """Label, observe, score and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run")
    parser.add_argument("--houses", default="builtin")
    parser.add_argument("--objects", default="builtin")
    parser.add_argument("--checkpoint")
    parser.add_argument("--draws", type=int, default=2)
    parser.add_argument("--views", type=int, default=2)
    options = parser.parse_args()
    if options.draws < 2:
        parser.error("--draws: labels of a draw need another that judges them. Give 2 or more")
    picked: dict[str, list[tuple[float, float]]] = {}
    decisive = list[bool]()
    for labels, rows in _scenes(options):
        decisive.append(DECISIVE_SHARES[0] <= labels[0].mean() <= DECISIVE_SHARES[1])
        for name, row in rows.items():
            others = [labels[d, row] for d in range(1, len(labels)) if name != f"labels of draw {d}"]
            picked.setdefault(name, []).append((float(labels[0, row]), float(np.mean(others))))
    print(f"{len(decisive)} scenes, {sum(decisive)} decisive; {options.draws} other draws\n")
    print("| pick | all: stored | other draws | decisive: stored | other draws |")
    print("| --- | --- | --- | --- | --- |")
    for name, found in picked.items():
        good = np.array(found)
        means = [100 * side.mean(axis=0) for side in (good, good[np.array(decisive)])]
        print(f"| {name} | " + " | ".join(f"{value:.1f}" for mean in means for value in mean) + " |")


def _scenes(options: argparse.Namespace) -> Iterator[tuple[I64, dict[str, int]]]:
    """Labels (1 + D, N) of a scene's candidates by draw, and the row that each way picks."""
    run, scorer = Run.open(options.run), load_scorer(options.checkpoint)
    spec = run.manifest.spec
    world = open_world(spec, options.houses, options.objects)
    stream = SampleStream([options.run], scenes_per_batch=1, shuffle=False, allow_incomplete=False)
    count = run.n // run.layout.candidates_per_scene
    for (number, stored), batch in zip(stored_scenes(run, count), stream.epoch(0), strict=True):
        scene = reconstruct_scene(world, stored.record)
        candidates = reconstruct_candidates(stored.samples, scene)
        near = np.array(within_reach(scene, candidates), np.int64)
        labels = [stored.samples["label"][near].astype(np.int64)]
        if not labels[0].any():
            continue
        for draw in range(1, options.draws + 1):
            labelling = Labelling(f"draw {draw}", spec, draw)
            label_scene(labelling, scene, candidates, near.tolist())
            labels.append(np.array([outcome == "success" for outcome in labelling.outcomes], np.int64))
        off = np.abs(stored.samples["mount_distance_m"][near] / candidates.arm_reach_m[near] - _SHARE)
        rows = {"nearest to 0.75 of the reach": int(np.argmin(off))}
        clouds = [
            batch.clouds,
            *_views(scene, str(stored.record["room_id"]), spec, batch.clouds, number, options.views),
        ]
        seen = {"model": clouds[0], "model, another view": clouds[min(1, len(clouds) - 1)]}
        seen[f"model, {1 + options.views} views"] = _fused(
            clouds, spec.observation, np.random.default_rng([_SEED, number])
        )
        for name, cloud in seen.items():
            rows[name] = int(np.argmax(scorer.score(replace(batch, clouds=cloud))[near]))
        for draw in range(1, options.draws + 1):
            rows[f"labels of draw {draw}"] = int(np.argmax(labels[draw] - off))
        yield np.array(labels), rows


def _views(
    scene: ReconstructedScene, room_id: str, spec: Specification, like: Clouds[Array], number: int, count: int
) -> Iterator[Clouds[Array]]:
    """The scene's clouds from up to `count` other viewpoints, each drawn as the first was."""
    house, centre_m, params = scene.house, scene.target_center_m, spec.observation
    for view in range(1, count + 1):
        rng = np.random.default_rng([_SEED, number, view])
        room = house.house.room(room_id)
        try:
            camera, _ = draw_viewpoint(
                scene.rays, room, house.obstacles, centre_m, params, spec.candidates, rng
            )
        except SceneRejected:  # no other place sees the target
            continue
        radius_m = float(scene.rays.radii_m[0])
        seen = observe_cloud(
            lambda pixels, camera=camera: cast_pixels(scene.rays, camera, pixels),
            camera,
            1,
            centre_m,
            radius_m,
            params,
            rng,
        )
        yield _as(seen, like)


def _as(seen: Cloud, like: Clouds[Array]) -> Clouds[Array]:
    points_m, n = seen.points_m[None].astype(np.float32), np.array([seen.n], np.int64)
    return replace(
        like, points_m=points_m, rgb=seen.rgb[None], target_mask=seen.target_mask[None], n_points=n
    )


def _fused(
    clouds: Sequence[Clouds[Array]], params: ObservationParams, rng: np.random.Generator
) -> Clouds[Array]:
    """As many points of all the clouds as one has, those of the target first drawn."""
    points_m, rgb, mask = (
        np.concatenate([getattr(c, name)[0, : c.n_points[0]] for c in clouds])
        for name in ("points_m", "rgb", "target_mask")
    )
    order = rng.permutation(len(points_m))
    on = order[mask[order]][:_TARGET_POINTS]
    order = np.concatenate([on, order[~np.isin(order, on)]])
    return _as(stored_cloud(points_m[order], rgb[order], mask[order], params), clouds[0])


if __name__ == "__main__":
    main()

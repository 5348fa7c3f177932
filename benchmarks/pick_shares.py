"""What limits picks of base poses: the view, the labels or the model; as a table by place and by run.

    python -m benchmarks.pick_shares RUN... --houses procthor:DIR --objects ycb:DIR [--views 2]

Runs of `plan` with whole grids and several draws, as the benchmark's. Of each scene in which most draws find
a plan from a clear candidate, a row picks one of the clear candidates, and is judged by most draws:

- nearest to 0.75 of the reach
- the model, from the stored cloud; from another viewpoint, where one sees the target; from the clouds of all
  viewpoints in one
- one draw: any of those from which one draw finds a plan. It knows the whole scene: what is lacking there are
  plans that do not repeat.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from datagen.evaluation.runs import draws_of
from datagen.schemas.run import Run
from datagen.schemas.shard_reading import read_scenes
from datagen.schemas.specification import PLACE_KINDS, ObservationParams, Specification
from datagen.train.dataset import SampleStream
from datagen.train.inputs import F64, Array, Clouds
from datagen.train.prediction import load_scorer
from datagen.workers.rendering.cloud import Cloud, stored_cloud
from datagen.workers.scenes.generate import observe
from datagen.workers.scenes.placement import SceneRejected
from datagen.workers.scenes.reconstruct import ReconstructedScene, reconstruct_scene
from datagen.workers.world import open_world

_SHARE = 0.75  # of the reach
_TARGET_POINTS = 256  # of the target in a fused cloud
_SEED = 0


def main() -> None:
    """Observe, score and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", nargs="+")
    parser.add_argument("--houses", default="builtin")
    parser.add_argument("--objects", default="builtin")
    parser.add_argument("--checkpoint")
    parser.add_argument("--views", type=int, default=2, help="other viewpoints")
    options = parser.parse_args()
    good: dict[str, list[dict[str, float]]] = {}
    for path in options.runs:
        for place, found in _scenes(path, options):
            for group in (place, Path(path).name, "all"):
                good.setdefault(group, []).append(found)
    names = [
        *(kind for kind in PLACE_KINDS if kind in good),
        *(Path(path).name for path in options.runs),
        "all",
    ]
    print("| pick | " + " | ".join(f"{name} ({len(good[name])})" for name in names) + " |")
    print("| --- " * (1 + len(names)) + "|")
    for way in good["all"][0]:
        shares = [100 * np.mean([found[way] for found in good[name]]) for name in names]
        print(f"| {way} | " + " | ".join(f"{share:.1f}" for share in shares) + " |")


def _scenes(path: str, options: argparse.Namespace) -> Iterator[tuple[str, dict[str, float]]]:
    """The kind of place of each feasible scene, and how good each way's pick is there."""
    run, scorer = Run.open(path), load_scorer(options.checkpoint)
    spec, count = run.manifest.spec, run.n // run.layout.candidates_per_scene
    draws = draws_of(path, [spec]) or 1
    world = open_world(spec, options.houses, options.objects)
    stream = SampleStream([path], scenes_per_batch=1, shuffle=False)
    for stored, batch in zip(read_scenes(run, range(count)), stream.epoch(0), strict=True):
        clear = stored.samples["base_is_clear"]
        found = stored.samples["successes"] * clear
        is_good = 2 * found > draws
        if not is_good.any():
            continue
        scene = reconstruct_scene(world, stored.record)
        clouds = [batch.clouds, *_views(scene, stored.record, spec, batch.clouds, options.views)]
        fused = _fused(clouds, spec.observation, np.random.default_rng([_SEED, scene.index]))
        seen = {
            "model": batch.clouds,
            "model, from another viewpoint": clouds[min(1, len(clouds) - 1)],
            f"model, clouds of {1 + options.views} viewpoints in one": fused,
        }
        off = np.abs(stored.samples["mount_distance_m"] / stored.samples["arm_reach_m"] - _SHARE)
        scores = {"nearest to 0.75 of the reach": -off}
        scores |= {way: scorer.score(replace(batch, clouds=cloud)) for way, cloud in seen.items()}
        rated = {
            way: _share_of_best(np.where(clear, score, -np.inf), is_good) for way, score in scores.items()
        }
        one_draw = float(found[is_good].sum() / found.sum())
        yield PLACE_KINDS[int(stored.record["place"])], rated | {"one draw": one_draw}


def _share_of_best(score: F64, is_good: Array) -> float:
    return float(is_good[score == score.max()].mean())


def _views(
    scene: ReconstructedScene, record: dict[str, Array], spec: Specification, like: Clouds[Array], count: int
) -> Iterator[Clouds[Array]]:
    """The scene's clouds from up to `count` other viewpoints, each drawn as the first was."""
    for view in range(1, count + 1):
        item = scene.index, scene.retry, view
        try:
            observed = observe(scene.house, str(record["room_id"]), scene.geometry, scene.rays, spec, item)
        except SceneRejected:  # no other place sees the target
            continue
        yield _as(observed[2](), like)


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

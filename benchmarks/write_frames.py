r"""Write frames of test scenes as folders for `datagen predict --frame`, such as those of the documents.

    python -m benchmarks.write_frames FOLDER --houses procthor:DIR --objects ycb:DIR [--scenes 3] [--seed 77]

Each scene is drawn in a house of the test split and rendered with stereo noise. The camera's height, for
`--camera-height`, is printed. The pictures docs/images/predict.png and predict-unseen.png were made by

    python -m benchmarks.write_frames FRAMES --houses procthor:DIR --objects ycb:DIR
    datagen predict --frame FRAMES/frame2 --camera-height 1.333 --base-height 0.7 --reach 0.9 \
        --out predict.png

and the last command with frame1 and --camera-height 1.346.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.frame_to_pose import house_map
from datagen.schemas.run import Run
from datagen.schemas.run_records import StageClock
from datagen.schemas.shard_reading import read_scenes
from datagen.schemas.specification import Source, Specification
from datagen.workers.bases.clearance import STEP_M
from datagen.workers.geometry.transforms import look_at
from datagen.workers.houses import open_houses
from datagen.workers.objects import open_objects
from datagen.workers.occupancy_map import FREE, OCCUPIED, OccupancyMap
from datagen.workers.rendering.embree import render_rays
from datagen.workers.scenes import Scene
from datagen.workers.scenes.generate import generate_scene
from datagen.workers.scenes.reconstruct import ReconstructedScene, reconstruct_scene
from datagen.workers.world import assemble_world, open_world
from tests.train.prediction.seen_scenes import Seen, write_frame

_BELOW_M = 0.25  # --eye looks that far below the target, so that floor is in the picture
LOW_M = 0.7  # of the map: what stands up to this height is in a base's way


def main() -> None:
    """Draw the scenes and write their frames."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--houses", default="builtin")
    parser.add_argument("--objects", default="builtin")
    parser.add_argument("--scenes", type=int, default=3)
    parser.add_argument("--seed", type=int, default=77)
    parser.add_argument("--split", default="test")
    parser.add_argument("--posed", action="store_true", help="write camera's pose and house's map too")
    parser.add_argument("--eye", type=float, nargs=3, help="another place of the camera (m)")
    parser.add_argument("--first", type=int, default=0, help="the first scene")
    parser.add_argument("--run", help="write frames of scenes of this run instead")
    parser.add_argument("--numbers", type=int, nargs="+", default=[0], help="of --run")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    if options.run is not None:
        run = Run.open(options.run)
        world = open_world(run.manifest.spec, options.houses, options.objects)
        for number, stored in zip(options.numbers, read_scenes(run, options.numbers), strict=True):
            scene = reconstruct_scene(world, stored.record)
            write(options.folder / f"scene{number}", scene, options.posed)
        return
    opened = open_houses(options.houses), open_objects(options.objects)
    house, thing = (Source(kind=source.kind, digest=source.digest) for source in opened)
    spec = Specification(seed=options.seed, split=options.split, houses=house, objects=thing)
    world = assemble_world(spec, *opened, options.houses, options.objects)
    for index in range(options.first, options.first + options.scenes):
        scene, _ = generate_scene(world, index, StageClock())
        write(options.folder / f"frame{index}", scene, options.posed, options.eye)


def write(
    folder: Path, scene: Scene | ReconstructedScene, posed: bool, eye_m: list[float] | None = None
) -> None:
    """Render the frame of a scene with stereo noise, and write it with or without pose and map."""
    camera = scene.camera
    if eye_m is not None:
        below_m = scene.target_center_m - [0.0, 0.0, _BELOW_M]
        camera = replace(camera, T_world_camera=look_at(np.array(eye_m), below_m))
    seen = Seen(scene, render_rays(scene.rays, camera)).noisy()
    print(f"{write_frame(folder, seen, posed=posed)}  camera height {camera.T_world_camera[2, 3]:.3f} m")
    if posed:
        write_map(folder, house_map(scene.house.house, STEP_M, LOW_M))


def write_map(folder: Path, known: OccupancyMap) -> None:
    """Write a map as Nav2's map_saver does: map.yaml and map.png."""
    grey = np.select([known.cells == FREE, known.cells == OCCUPIED], [254, 0], 205).astype(np.uint8)
    Image.fromarray(grey[::-1]).save(folder / "map.png", optimize=True)
    x, y, turn = known.origin
    (folder / "map.yaml").write_text(
        f"image: map.png\nmode: trinary\nresolution: {known.resolution_m}\n"
        f"origin: [{x:.4f}, {y:.4f}, {turn}]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )


if __name__ == "__main__":
    main()

"""How well a target's centre, its pixels and the floor are found in rendered frames, as tables.

    python -m benchmarks.frames [--scenes 80] [--houses procthor:DIR] [--objects ycb:DIR] [--seed 77]

Scenes of the test houses as runs draw them, each frame once exact and once with the stereo noise of
`workers/rendering/noise.py`, depth in whole millimetres. Centre: error of the estimate from the true mask.
Click: overlap (intersection over union) of the region grown from the target's middle pixel and the true mask,
0 for a click that is refused.
Floor: tilt, and the error in the target's height, where it is found from the image and the camera's height;
wrong where these are above 3 degrees or 40 mm, doubted where the answer says that the floor is uncertain.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np

from benchmarks.options import drawn_scenes
from datagen.schemas.errors import InputError
from datagen.schemas.specification import NoiseParams
from datagen.train.prediction.clicks import click_mask
from datagen.train.prediction.frames import Pinhole, RgbdImage, SensorFrame, image_frame
from datagen.train.prediction.ground import find_ground, floor_points
from datagen.train.prediction.target import locate
from datagen.workers.geometry.mesh import F64
from datagen.workers.rendering.embree import render_rays
from datagen.workers.rendering.noise import add_noise
from datagen.workers.scenes import Scene


def main() -> None:
    """Draw the scenes and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--scenes", type=int, default=80)
    parser.add_argument("--houses", default="builtin")
    parser.add_argument("--objects", default="builtin")
    parser.add_argument("--seed", type=int, default=77)
    options = parser.parse_args()
    rows: dict[str, list[tuple[F64, float, F64 | None, bool]]] = {"exact": [], "noisy": []}
    for scene, frames in _scenes(options):
        for name, frame in frames.items():
            if frame is not None:
                rows[name].append((_centre(scene, frame), _overlap(scene, frame), *_floor(scene, frame)))
    for name, found in rows.items():
        centre = 1000 * np.array([row[0] for row in found])
        error = np.linalg.norm(centre[:, :3], axis=1)
        along, across, up = np.median(centre[:, :3], axis=0)
        print(f"{name}, {len(found)} frames")
        print(f"  centre: along {along:.1f}, across {across:.1f}, up {up:.1f} mm (medians);", end=" ")
        print(f"error {np.median(error):.1f} mm, 90 % below {np.percentile(error, 90):.1f} mm;", end=" ")
        naive = centre[:, 3]
        print(f"middle of the visible points {np.median(naive):.1f}, {np.percentile(naive, 90):.1f} mm")
        overlap = np.array([row[1] for row in found])
        print(f"  click: overlap {np.median(overlap):.2f} in the median, 10 % below", end=" ")
        print(f"{np.percentile(overlap, 10):.2f}; above 0.7 in {(overlap > 0.7).sum()}")
        tilts = np.array([row[2] for row in found if row[2] is not None])
        floor = np.array([row[3] for row in found])
        missed = sum(row[2] is None and row[3] for row in found)
        wrong = sum(row[2] is not None and (row[2][0] > 3 or row[2][1] > 40) for row in found)
        unsure = [row[2][2] > 0 for row in found if row[2] is not None and (row[2][0] > 3 or row[2][1] > 40)]
        print(f"  floor: in {floor.sum()} frames; found in {len(tilts)}, missed in {missed};", end=" ")
        print(
            f"doubted in {(tilts[:, 2] > 0).sum()}, wrong in {wrong}, {sum(unsure)} of them doubted;", end=" "
        )
        print(
            f"tilt {np.median(tilts[:, 0]):.2f} deg, target's height off by {np.median(tilts[:, 1]):.1f} mm,",
            end=" ",
        )
        print(f"90 % below {np.percentile(tilts[:, 1], 90):.1f} mm")


def _scenes(options: argparse.Namespace) -> Iterator[tuple[Scene, dict[str, SensorFrame | None]]]:
    for index, scene in drawn_scenes(options):
        exact = render_rays(scene.rays, scene.camera)
        noisy = add_noise(exact, NoiseParams(enabled=True), np.random.default_rng([options.seed, index]))
        frames: dict[str, SensorFrame | None] = {}
        for name, frame in (("exact", exact), ("noisy", noisy)):
            c = frame.camera
            pinhole = Pinhole(c.fx_px, c.fy_px, c.cx_px - 0.5, c.cy_px - 0.5)
            depth_m = (np.round(1000 * frame.depth_m) / 1000).astype(np.float32)
            seen = ((frame.body == 1) & (depth_m > 0)).sum() >= 30  # fewer are refused
            image = RgbdImage(frame.rgb, depth_m, pinhole, frame.body == 1)
            frames[name] = image_frame(image, c.T_world_camera, {}) if seen else None
        yield scene, frames


def _centre(scene: Scene, frame: SensorFrame) -> F64:
    """Error (4,) along the sight line, across it and up, and that of the middle of the visible points."""
    T, centre = scene.camera.T_world_camera, scene.target_center_m
    world = frame.points_m.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    assert frame.on_target is not None
    target, others = world[frame.on_target], world[~frame.on_target]
    off = np.array(locate(target, others, T[:3, 3]).center_m) - centre
    ahead = (centre - T[:3, 3])[:2] / np.linalg.norm((centre - T[:3, 3])[:2])
    middle = np.linalg.norm(np.median(target, axis=0) - centre)
    return np.array([off[:2] @ ahead, off[:2] @ [-ahead[1], ahead[0]], off[2], middle])


def _overlap(scene: Scene, frame: SensorFrame) -> float:
    image = frame.image
    assert image is not None and image.mask is not None
    truth = image.mask & (image.depth_m > 0)
    v, u = np.nonzero(truth)
    middle = [axis.mean() for axis in np.nonzero(image.mask)]
    k = int(np.argmin((v - middle[0]) ** 2 + (u - middle[1]) ** 2))
    try:
        grown = click_mask(image, (int(u[k]), int(v[k])), scene.camera.T_world_camera)
    except InputError:
        return 0.0
    return float((grown & truth).sum() / (grown | truth).sum())


def _floor(scene: Scene, frame: SensorFrame) -> tuple[F64 | None, bool]:
    """(tilt in degrees, error of the target's height in mm, doubted) or None; whether a floor is in sight."""
    true = scene.camera.T_world_camera
    world = frame.points_m @ true[:3, :3].T + true[:3, 3]
    has_floor = bool(floor_points(world, true[:3, 3]).mean() > 0.03)
    unposed = SensorFrame(frame.place, frame.points_m, frame.rgb, frame.on_target, None, frame.image)
    try:
        ground = find_ground(unposed, float(true[2, 3]), None)
    except InputError:
        return None, has_floor
    found = ground.T_world_camera
    tilt = np.degrees(np.arccos(min(1.0, float(found[2, :3] @ true[2, :3]))))
    centre = np.append(scene.target_center_m, 1.0)
    height = (found @ np.linalg.inv(true) @ centre)[2]
    return np.array([tilt, 1000 * abs(height - centre[2]), ground.doubt is not None]), has_floor


if __name__ == "__main__":
    main()

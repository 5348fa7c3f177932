"""Real scenes observed by the project's own renderer, as files and frames that a camera would give."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from datagen.schemas.run_records import StageClock
from datagen.schemas.specification import NoiseParams, ObservationParams, Source, Specification
from datagen.train.prediction.frames import Pinhole, RgbdImage, SensorFrame, image_frame
from datagen.workers.geometry.mesh import F64
from datagen.workers.geometry.transforms import look_at
from datagen.workers.houses import open_houses
from datagen.workers.objects import open_objects
from datagen.workers.rendering import Camera, Frame
from datagen.workers.rendering.embree import render_rays
from datagen.workers.rendering.noise import add_noise
from datagen.workers.scenes import Scene
from datagen.workers.scenes.generate import generate_scene
from datagen.workers.scenes.reconstruct import ReconstructedScene
from datagen.workers.world import assemble_world

MODEL = {"n_points": 2048, "tokens": [32, 64, 64], "width": 16, "embedding": 32, "head": [32]}
OBSERVATION = ObservationParams(width_px=320, height_px=240, fx_px=307.5, fy_px=307.5)


@dataclass(frozen=True, eq=False)
class Seen:
    """A scene with the whole frame of its observation camera."""

    scene: Scene | ReconstructedScene
    frame: Frame

    @property
    def camera(self) -> Camera:
        return self.scene.camera

    @property
    def height_m(self) -> float:
        """Of the observation camera above the floor."""
        return float(self.camera.T_world_camera[2, 3])

    def noisy(self) -> Seen:
        """The same, as a stereo camera has it."""
        params = NoiseParams(enabled=True)
        return Seen(self.scene, add_noise(self.frame, params, np.random.default_rng(3)))

    def turned_to(self, eye_m: F64) -> Seen:
        """The same scene from another place, looking at the target."""
        camera = replace(self.camera, T_world_camera=look_at(eye_m, self.scene.target_center_m))
        return Seen(self.scene, render_rays(self.scene.rays, camera))


def draw_seen(index: int, seed: int = 0, houses: str = "builtin", objects: str = "builtin") -> Seen:
    """Scene `index` of a world, and its frame."""
    opened = open_houses(houses), open_objects(objects)
    house, thing = (Source(kind=source.kind, digest=source.digest) for source in opened)
    spec = Specification(seed=seed, houses=house, objects=thing, observation=OBSERVATION)
    scene, _ = generate_scene(assemble_world(spec, *opened, houses, objects), index, StageClock())
    return Seen(scene, render_rays(scene.rays, scene.camera))


def sensor_frame(
    seen: Seen, T_world_camera: F64 | None = None, *, posed: bool = True, mask: bool = True
) -> SensorFrame:
    """What a camera with whole millimetres would have given, with the pose of the scene or another."""
    c = seen.frame.camera
    depth_m = (np.round(seen.frame.depth_m * 1000) / 1000).astype(np.float32)
    pinhole = Pinhole(c.fx_px, c.fy_px, c.cx_px - 0.5, c.cy_px - 0.5)
    image = RgbdImage(seen.frame.rgb, depth_m, pinhole, seen.frame.body == 1 if mask else None)
    pose = c.T_world_camera if T_world_camera is None else T_world_camera
    return image_frame(image, pose if posed else None, {})


def camera_arrays(seen: Seen) -> tuple[np.ndarray, ...]:
    """rgb, depth in millimetres, K, T_map_camera and mask, as a driver has them."""
    c = seen.frame.camera
    K = np.array([[c.fx_px, 0, c.cx_px - 0.5], [0, c.fy_px, c.cy_px - 0.5], [0, 0, 1]])
    depth = np.round(seen.frame.depth_m * 1000).astype(np.uint16)
    return seen.frame.rgb, depth, K, c.T_world_camera, seen.frame.body == 1


def write_frame(folder: Path, seen: Seen, *, posed: bool = True, mask: bool = True) -> Path:
    """The folder with the files of the frame."""
    folder.mkdir()
    c = seen.frame.camera
    Image.fromarray(seen.frame.rgb).save(folder / "color.png")
    Image.fromarray(np.round(seen.frame.depth_m * 1000).astype(np.uint16)).save(folder / "depth.png")
    if mask:
        Image.fromarray((seen.frame.body == 1).astype(np.uint8) * 255).save(folder / "mask.png")
    numbers = {"fx": c.fx_px, "fy": c.fy_px, "ppx": c.cx_px - 0.5, "ppy": c.cy_px - 0.5}
    size = {"width": c.width_px, "height": c.height_px}
    (folder / "intrinsics.json").write_text(json.dumps({**numbers, **size, "model": "Brown Conrady"}))
    if posed:
        (folder / "pose.json").write_text(json.dumps({"T_world_camera": c.T_world_camera.tolist()}))
    return folder

"""Scenes' camera frames, rendered again, as folders that `predict` reads: colour, depth, masks, camera."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
from PIL import Image

from datagen.exports.export_run import ExportSource, Made, NewFile, Step, scene_key
from datagen.exports.webdataset import plain
from datagen.schemas.fields import SCHEMAS, SceneRows
from datagen.schemas.identity import Stream, generator
from datagen.schemas.run import Run
from datagen.workers.houses import split_of
from datagen.workers.rendering.noise import add_noise
from datagen.workers.rendering.shading import draw_light, render_shaded
from datagen.workers.scenes.generate import noise_of

_STEP_M, _MOST_STEPS = 0.001, 65_535  # of depth
_CAMERA = "x right, y down, z forward (OpenCV); the pixel in column u and row v has its centre at (u, v)"
# Of a record: its cloud, and what K and the pictures say with their own pixel centres.
_LEFT_OUT = ("points_m", "rgb", "target_mask", "n_points", "intrinsics_px")


def steps(source: ExportSource) -> Sequence[Step]:
    """A folder for each scene, then `frames.jsonl` with a line for each."""
    return [*source.each_scene(partial(_files, source)), partial(_lines, source)]


def _files(source: ExportSource, run: Run, rows: SceneRows) -> Iterator[NewFile]:
    scene, spec = source.rebuilt(run, rows.record), run.manifest.spec
    camera = scene.camera
    light = draw_light(camera, generator(spec.seed, Stream.LIGHT, scene.index, scene.retry))
    frame = render_shaded(scene.rays, scene.house.house, camera, light)
    if spec.observation.noise.enabled:  # the same as in the stored cloud
        noise_rng = noise_of(scene, str(rows.record["room_id"]), spec)
        frame = add_noise(frame, spec.observation.noise, noise_rng)
    depth = np.rint(frame.depth_m / _STEP_M)
    pictures = {
        "color": frame.rgb,
        "depth": np.where(depth > _MOST_STEPS, 0, depth).astype(np.uint16),
        "mask": np.where(frame.body == 1, 255, 0).astype(np.uint8),
        "objects": np.maximum(frame.body, 0).astype(np.uint8),
    }
    folder = scene_key(run.manifest.spec_hash, scene.index)
    for name, pixels in pictures.items():
        data = io.BytesIO()
        Image.fromarray(pixels).save(data, "PNG")
        yield NewFile(f"{folder}/{name}.png", data.getvalue())
    width, height = rows.record["image_size_px"].tolist()
    pose = {"T_world_camera": rows.record["T_world_camera"].tolist()}
    for name, values in (
        ("intrinsics", {"K": _matrix(rows), "width": width, "height": height}),
        ("pose", pose),
    ):
        yield NewFile(f"{folder}/{name}.json", json.dumps(values).encode())


def _matrix(rows: SceneRows) -> list[list[float]]:
    """K with pixel centres at whole numbers; in records they are at halves."""
    fx, fy, cx, cy = rows.record["intrinsics_px"].tolist()
    return [[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]]


def _lines(source: ExportSource, _: Made) -> Iterator[NewFile]:
    lines: list[str] = []
    for run, rows in source.scenes(source.first, source.past):
        fields = [f for f in SCHEMAS[run.schema.name].scene_fields if f.name not in _LEFT_OUT]
        record = plain(fields, rows.record)
        line = {
            "frame": scene_key(run.manifest.spec_hash, record["scene_index"]),
            "spec_hash": run.manifest.spec_hash,
            "split": split_of(record["house_id"]),
            "K": _matrix(rows),
            "camera_frame": _CAMERA,
            "depth_step_m": _STEP_M,
            **{name: None if value != value else value for name, value in record.items()},  # JSON has no NaN
        }
        lines.append(json.dumps(line, allow_nan=False) + "\n")
    yield NewFile("frames.jsonl", "".join(lines).encode())

"""Contact sheet: each object of a source, with its name, size, mass, and whether it can be a target."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from datagen.workers.geometry.mesh import Mesh
from datagen.workers.geometry.transforms import look_at
from datagen.workers.objects.model import ObjectModel, ObjectSource
from datagen.workers.rendering import Camera
from datagen.workers.rendering.embree import RayScene, cast_pixels, ray_mesh

_SIDE_PX, _SHARPNESS, _TEXT_PX, _COLUMNS = 180, 2, 46, 7
_FROM = np.array([0.75, -1.0, 0.8])  # towards the camera
_TARGET, _PAPER = (20, 110, 60), (255, 255, 255)
_PLATE = Mesh(
    np.array([(x, y, 0.0) for x in (-1.1, 1.1) for y in (-1.1, 1.1)], np.float32),
    np.array([[0, 2, 1], [1, 2, 3]], np.int32),
    np.full((2, 3), 230, np.uint8),
)


def draw_objects(source: ObjectSource, out: Path) -> None:
    """Write a PNG of all objects, each as large as its picture; targets have green names. Raises OSError."""
    names, pitch = source.names(), _SIDE_PX + _TEXT_PX
    sheet = Image.new("RGB", (_COLUMNS * _SIDE_PX, -(-len(names) // _COLUMNS) * pitch), _PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    for k, name in enumerate(names):
        model, x, y = source.load(name), k % _COLUMNS * _SIDE_PX, k // _COLUMNS * pitch
        sheet.paste(_picture(model), (x, y))
        short = name if len(name) < 28 else f"{name[:13]}..{name[-12:]}"
        facts = " x ".join(f"{100 * side:.1f}" for side in model.size_m) + f" cm, {model.mass_kg:.3g} kg"
        fill = _TARGET if model.can_be_target else "black"
        draw.text((x + 4, y + _SIDE_PX + 2), f"{short}\n{facts}", fill=fill, font=font)
    sheet.save(out)


def _picture(model: ObjectModel) -> Image.Image:
    """The object on a plate as wide as it."""
    T, px = np.diag([model.radius_m] * 3 + [1.0]), _SIDE_PX * _SHARPNESS
    T[2, 3] = -model.size_m[2] / 2
    eye_m = 6 * model.radius_m * _FROM / np.linalg.norm(_FROM)
    camera = Camera(look_at(eye_m, np.zeros(3)), px, px, 2.6 * px, 2.6 * px, px / 2, px / 2)
    objects, radii_m = [ray_mesh(model.visual)], np.array([model.radius_m])
    stage = RayScene(ray_mesh(_PLATE.transformed(T)), objects, radii_m, np.eye(4)[None])
    pixels = cast_pixels(stage, camera, np.arange(px * px))
    rgb = np.where((pixels.depth_m > 0)[:, None], pixels.rgb, _PAPER).astype(np.uint8)
    return Image.fromarray(rgb.reshape(px, px, 3)).reduce(_SHARPNESS)

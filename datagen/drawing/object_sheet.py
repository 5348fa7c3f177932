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
_FROM = np.array([0.75, -1.0, 0.8])  # towards the camera; x to the right, so that z is up in the picture
_FLOOR_RGB, _PAPER, _TARGET = (228, 231, 236), (255, 255, 255), (20, 110, 60)


def draw_objects(source: ObjectSource, out: Path) -> None:
    """Write a PNG of all objects, each as large as its picture; targets have green names. Raises OSError."""
    names = source.names()
    rows, pitch = -(-len(names) // _COLUMNS), _SIDE_PX + _TEXT_PX
    sheet = Image.new("RGB", (_COLUMNS * _SIDE_PX, rows * pitch), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    for k, name in enumerate(names):
        model, x, y = source.load(name), k % _COLUMNS * _SIDE_PX, k // _COLUMNS * pitch
        sheet.paste(_picture(model), (x, y))
        size = " x ".join(f"{100 * side:.1f}" for side in model.size_m)
        short = name if len(name) < 28 else f"{name[:13]}..{name[-12:]}"
        draw.text(
            (x + 4, y + _SIDE_PX + 2), short, fill=_TARGET if model.can_be_target else "black", font=font
        )
        facts = f"{size} cm, {model.mass_kg:.3g} kg"
        draw.text((x + 4, y + _SIDE_PX + 18), facts, fill="black", font=font)
    sheet.save(out)


def _picture(model: ObjectModel) -> Image.Image:
    """The object on a plate as wide as it."""
    side, low = model.radius_m * 1.1, -model.size_m[2] / 2
    corners = np.array([(x, y, low) for x in (-side, side) for y in (-side, side)], np.float32)
    plate = ray_mesh(
        Mesh(corners, np.array([[0, 2, 1], [1, 2, 3]], np.int32), np.array([_FLOOR_RGB] * 2, np.uint8))
    )
    far = 6 * model.radius_m * _FROM / np.linalg.norm(_FROM)
    px = _SIDE_PX * _SHARPNESS
    camera = Camera(look_at(far, np.zeros(3)), px, px, 2.6 * px, 2.6 * px, px / 2, px / 2)
    stage = RayScene(plate, [ray_mesh(model.visual)], np.array([model.radius_m]), np.eye(4)[None])
    pixels = cast_pixels(stage, camera, np.arange(px * px))
    rgb = np.where((pixels.depth_m > 0)[:, None], pixels.rgb, _PAPER).astype(np.uint8)
    return Image.fromarray(rgb.reshape(px, px, 3)).reduce(_SHARPNESS)

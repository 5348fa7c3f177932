"""What a folder of houses or objects gives: what is read, what is not and why, and its licences."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from datagen.display.progress import Progress
from datagen.schemas.errors import InputError
from datagen.workers.geometry.mesh import Mesh
from datagen.workers.geometry.transforms import look_at
from datagen.workers.houses import HOUSE_SOURCES, open_houses
from datagen.workers.houses.ai2thor import root_of
from datagen.workers.houses.procthor import house_documents
from datagen.workers.objects import OBJECT_SOURCES, ObjectModel, ObjectSource, open_objects
from datagen.workers.rendering import Camera
from datagen.workers.rendering.embree import RayScene, cast_pixels, ray_mesh
from datagen.workers.source_statement import STATEMENT
from datagen.workers.survey import Survey, survey_sources

_LICENCES = ("licen", "copying", STATEMENT)
_MOST_LICENCES = 20


def check_source(given: str, shown: Progress) -> tuple[str, Survey, list[str], ObjectSource | None]:
    """Open and examine `KIND:DIR`, or DIR, whose kind follows from its content. Raises InputError.

    Returns the reference, what was read, files that state licences, and the source; None for houses.
    """
    kind, _, text = given.partition(":")
    if kind not in HOUSE_SOURCES | OBJECT_SOURCES:
        text = given
        kind = _kind_of(Path(text).expanduser())
    ref, of_houses = f"{kind}:{text}", kind in HOUSE_SOURCES
    if not text:
        raise InputError(given, "", "has no files to check", "Name a folder of houses or objects")
    shown.phase("opening houses and objects")
    houses, objects = (
        open_houses(ref if of_houses else "builtin"),
        open_objects("builtin" if of_houses else ref),
    )
    surveys = survey_sources(houses, objects, shown.counter("houses examined"))
    folder = Path(text).expanduser()
    found = (str(p.relative_to(folder)) for p in folder.rglob("*") if p.name.lower().startswith(_LICENCES))
    licences = sorted(islice(found, _MOST_LICENCES))
    return ref, surveys["houses" if of_houses else "objects"], licences, None if of_houses else objects


def object_rows(source: ObjectSource) -> list[dict[str, Any]]:
    """Name, size, mass, number of parts and remarks of each usable object."""
    notes = getattr(source, "notes", {})
    return [
        {"name": m.name, "size_m": list(m.size_m), "mass_kg": m.mass_kg, "parts": len(m.convex_parts_m)}
        | {"can_be_target": m.can_be_target, "notes": notes.get(m.name, {})}
        for m in map(source.load, source.names())
    ]


def _kind_of(folder: Path) -> str:
    if not folder.is_dir():
        raise InputError(folder, "", "is not a folder", "Give a folder of houses or objects, or KIND:DIR")
    if any(path.name.endswith((".jsonl", ".jsonl.gz")) for path in folder.iterdir()):
        return "procthor"
    if any(path.with_suffix(".toml").exists() for path in folder.glob("*.yaml")):
        return "map"
    if any(folder.glob("*.scene_dataset_config.json")):
        return "habitat"
    if any(house_documents(folder)):
        return "procthor"
    return "ai2thor" if root_of(folder) is not None else "folder"


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

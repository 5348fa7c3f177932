"""How often a click or a box selects the right object, in annotated frames and in rendered scenes.

    python -m benchmarks.clicks [FOLDER ...] [--boxes] [--scenes 20] [--houses procthor:DIR] [--objects ycb:D]

A folder holds frames as `datagen predict` reads them, each with pose.json and labels.png: 16 bits, 0 for what
is not asked for, 65535 for the room (floor, walls, furniture), another number for each object. Scenes of the
test houses are rendered as they are, and with a copy of the target on top of it and another object that
touches it; exact, with stereo noise, and with the steps of the first Kinect (2.85 mm at 1 m).

Five clicks an object that shows 300 pixels, inside its outline: in its middle, and halfway to its four ends.
Right: the mask overlaps the object's pixels with depth by at least half (intersection over union), all or
those of the clicked one of parts into which another object splits it, and holds less than half of any other.
Five clicks a frame on the room: right if refused. With --boxes one box an object in place of clicks, 3 pixels
wider on each side than its pixels.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy import ndimage

from benchmarks.options import drawn_scenes
from datagen.schemas.errors import InputError
from datagen.schemas.specification import NoiseParams
from datagen.train.inputs import Bools
from datagen.train.prediction.clicks import Box, box_mask, click_mask
from datagen.train.prediction.frames import Pinhole, RgbdImage, read_place
from datagen.workers.geometry.mesh import F64
from datagen.workers.rendering import Frame
from datagen.workers.rendering.embree import RayScene, render_rays
from datagen.workers.rendering.noise import add_noise

Labels = npt.NDArray[np.int64]
ROOM, LEAST_PX, CLICKS = 65535, 300, 5
_WORDS = "right", "refused"  # at the start of verdicts


def main() -> None:
    """Click, and print a table by source of the frames."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="*")
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--houses", default="builtin")
    parser.add_argument("--objects", default="builtin")
    parser.add_argument("--seed", type=int, default=77)
    parser.add_argument("--each", action="store_true", help="print objects with a click that is not right")
    parser.add_argument("--boxes", action="store_true", help="give boxes in place of clicks")
    options = parser.parse_args()
    select, places = (box_mask, _box) if options.boxes else (click_mask, clicks_on)
    counts: dict[str, npt.NDArray[np.int64]] = {}
    spent = list[float]()
    for source, name, image, T, labels in [*_folders(options.folders), *_scenes(options)]:
        if source not in counts:
            counts[source] = np.zeros(9, np.int64)
        counts[source][0] += 1
        for label in np.unique(labels[labels > 0]):
            asked = (labels == label) & (image.depth_m > 0)
            if asked.sum() < LEAST_PX or (label == ROOM and options.boxes):
                continue
            rng = np.random.default_rng(0)
            said = list[str]()
            given: list[Any] = _inner(asked, rng) if label == ROOM else places(asked)
            middle = clicks_on(asked)[0]
            for place in given:
                began = time.process_time()
                mask = _selected(select, image, place, T)
                spent.append(time.process_time() - began)
                at = middle if options.boxes else place
                said.append(f"{_verdict(mask, image, labels, at)} at {place}")
            n, right, refused = len(said), *(sum(each.startswith(word) for each in said) for word in _WORDS)
            if label == ROOM:
                counts[source][7:] += n, refused
            else:
                counts[source][1:7] += 1, right == n, n, right, refused, n - right - refused
            if options.each and (refused if label == ROOM else right) < n:
                print(f"{source} {name} {label}: {'; '.join(said)}")
    head = ("frames", "objects", "all right", "clicks", "right", "refused", "wrong", "on room", "refused")
    print("".join(["source".ljust(24), *(word.rjust(10) for word in head)]))
    for source, row in counts.items():
        print("".join([source.ljust(24), *(str(n).rjust(10) for n in row)]), f"{row[4] / max(row[3], 1):.1%}")
    print(f"CPU each: median {1000 * np.median(spent):.0f} ms, most {1000 * max(spent):.0f} ms")


def _selected(
    select: Callable[[RgbdImage, Any, F64], Bools], image: RgbdImage, place: Any, T: F64
) -> Bools | str:
    """The mask of what is clicked or boxed, or why it is refused."""
    try:
        return select(image, place, T)
    except InputError as refused:
        return refused.problem


def _verdict(mask: Bools | str, image: RgbdImage, labels: Labels, pixel: tuple[int, int]) -> str:
    """Whether a mask is right for the object at a pixel."""
    if isinstance(mask, str):
        return f"refused: {mask}"
    known = image.depth_m > 0
    asked = (labels == labels[pixel[1], pixel[0]]) & known
    parts = np.zeros(asked.shape, np.int64)
    ndimage.label(asked, output=parts)
    overlap = max(
        (mask & wanted).sum() / ((mask & known) | wanted).sum()
        for wanted in (asked, parts == parts[pixel[1], pixel[0]])
    )
    held = [
        other
        for other in np.unique(labels[mask & ~asked & (labels != ROOM)])
        if other and (mask & (labels == other)).sum() > 0.5 * ((labels == other) & known).sum()
    ]
    return f"{'right' if overlap >= 0.5 and not held else 'wrong'}: {overlap:.2f} {held or ''}"


def _box(asked: Bools) -> list[Box]:
    (top, *_, bottom), (left, *_, right) = (np.flatnonzero(asked.any(axis)) for axis in (1, 0))
    h, w = asked.shape
    return [(max(int(left) - 3, 0), max(int(top) - 3, 0), min(int(right) + 4, w), min(int(bottom) + 4, h))]


def clicks_on(asked: Bools) -> list[tuple[int, int]]:
    """The middle pixel (u, v) of an object, and those halfway to its four ends, inside its outline."""
    cut = ndimage.find_objects(asked.astype(np.int8))[0]
    inside = np.asarray(ndimage.distance_transform_edt(np.pad(asked[cut], 1)))[1:-1, 1:-1]
    v, u = (
        part + each.start for part, each in zip(np.nonzero(inside > 0.4 * inside.max()), cut, strict=True)
    )
    at, half = np.stack([u, v], axis=1), np.array([u.mean(), v.mean()])
    ends = [at[k] for k in (u.argmin(), u.argmax(), v.argmin(), v.argmax())]
    near = [
        np.abs(at - wanted).sum(axis=1).argmin() for wanted in [half, *((half + end) / 2 for end in ends)]
    ]
    return [(int(u[k]), int(v[k])) for k in near]


def _inner(asked: Bools, rng: np.random.Generator) -> list[tuple[int, int]]:
    v, u = np.nonzero(asked)
    return [(int(u[k]), int(v[k])) for k in rng.choice(len(v), CLICKS, replace=False)]


Case = tuple[str, str, RgbdImage, F64, Labels]


def _folders(folders: list[Path]) -> Iterator[Case]:
    for folder in folders:
        for path in sorted(folder.rglob("labels.png")):
            frame = read_place(path.parent)
            assert frame.image is not None and frame.T_world_camera is not None
            labels = np.asarray(Image.open(path)).astype(np.int64)
            yield folder.name, path.parent.name, frame.image, frame.T_world_camera, labels


def _scenes(options: argparse.Namespace) -> Iterator[Case]:
    for index, scene in drawn_scenes(options):
        for kind, rays in (("rendered", scene.rays), ("stacked", _stacked(scene.rays))):
            exact = render_rays(rays, scene.camera)
            for name, params in _noises(scene.camera.fx_px).items():
                frame = add_noise(exact, params, np.random.default_rng(index)) if params.enabled else exact
                yield f"{kind}, {name}", str(index), *case_of(frame)


def _noises(fx_px: float) -> dict[str, NoiseParams]:
    # The renderer's disparity has steps of 1/32 pixel; this base line makes them 2.85 mm at 1 m.
    kinect_m = 1 / (32 * 2.85e-3 * fx_px)
    return {
        "exact": NoiseParams(),
        "stereo": NoiseParams(enabled=True),
        "Kinect": NoiseParams(enabled=True, baseline_m=kinect_m, disparity_std_px=0.5 / 32),
    }


def _stacked(rays: RayScene) -> RayScene:
    """The scene with a copy of the target on top of it, and the next object moved to where it touches it."""
    poses, low, high = [*rays.T_world_object], list[F64](), list[F64]()
    for mesh, T in zip(rays.objects, poses, strict=True):
        corners = mesh.mesh.vertices_m @ T[:3, :3].T + T[:3, 3]
        low.append(corners.min(axis=0))
        high.append(corners.max(axis=0))
    top = poses[0].copy()
    top[2, 3] += high[0][2] - low[0][2]
    if len(poses) > 1:
        poses[1] = poses[1].copy()
        poses[1][0, 3] += high[0][0] - low[1][0]
        poses[1][1, 3] += (high[0][1] + low[0][1] - high[1][1] - low[1][1]) / 2
        poses[1][2, 3] += low[0][2] - low[1][2]
    objects, radii = [*rays.objects, rays.objects[0]], np.append(rays.radii_m, rays.radii_m[0])
    return replace(rays, objects=objects, radii_m=radii, T_world_object=np.array([*poses, top]))


def case_of(frame: Frame) -> tuple[RgbdImage, F64, Labels]:
    """A rendered frame as `predict` reads it, its camera's pose, and its labels (H, W)."""
    c, body = frame.camera, frame.body.astype(np.int64)
    pinhole = Pinhole(c.fx_px, c.fy_px, c.cx_px - 0.5, c.cy_px - 0.5)
    depth_m = (np.round(1000 * frame.depth_m) / 1000).astype(np.float32)
    image = RgbdImage(frame.rgb, depth_m, pinhole, None)
    return image, c.T_world_camera, np.where(body == 0, ROOM, np.maximum(body, 0))


if __name__ == "__main__":
    main()

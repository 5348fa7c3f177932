"""RGB-D frames of a scene. RENDERERS is the registry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from datagen.workers.geometry.mesh import F32, F64, U8
from datagen.workers.houses.house import House
from datagen.workers.objects.model import ObjectModel
from datagen.workers.registry import entry

I16 = npt.NDArray[np.int16]


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera; its frame has x right, y down, z forward (OpenCV).

    Pixel (u, v) has its centre at u + 0.5, v + 0.5; `cx_px`, `cy_px` are in the same units.
    """

    T_world_camera: F64  # (4, 4)
    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float


@dataclass(frozen=True, eq=False)
class SceneGeometry:
    """A house and the objects placed in it."""

    house: House
    objects: Sequence[ObjectModel]
    T_world_object: F64  # (K, 4, 4)


@dataclass(frozen=True, eq=False)
class Frame:
    """One RGB-D image. `depth_m` is along the camera's z axis; 0 where nothing was measured.

    `body` is the number of the body in each pixel: -1 none, 0 the house, 1 + k object k.
    """

    camera: Camera
    rgb: U8  # (H, W, 3)
    depth_m: F32  # (H, W)
    body: I16  # (H, W)


@dataclass(frozen=True, eq=False)
class Pixels:
    """N pixels of a frame; fields as in Frame."""

    rgb: U8  # (N, 3)
    depth_m: F32  # (N,)
    body: I16  # (N,)


def pixel_directions(camera: Camera, pixels: npt.NDArray[np.int64]) -> F32:
    """Directions (N, 3) in the camera frame, at depth 1, through the centres of flat pixel indices."""
    v, u = np.divmod(pixels, camera.width_px)
    x = (u + 0.5 - camera.cx_px) / camera.fx_px
    y = (v + 0.5 - camera.cy_px) / camera.fy_px
    return np.stack([x, y, np.ones(len(pixels))], axis=1).astype(np.float32)


Renderer = Callable[[SceneGeometry, Camera], Frame]


RENDERERS = {"embree": "datagen.workers.rendering.embree:render_embree"}


def load_renderer(name: str) -> Renderer:
    """The renderer of that name. Raises InputError where it is unknown or cannot be imported."""
    return entry(RENDERERS, name, "observation.renderer")

"""Frames of a depth camera: points in the camera frame, with their image."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from datagen.schemas.errors import InputError
from datagen.train.inputs import F32, F64, I64, U8, Bools
from datagen.train.prediction.files import (
    MAX_PIXELS,
    checked_pose,
    read_arrays,
    read_depth,
    read_intrinsics,
    read_mask,
    read_pose,
    read_rgb,
    valid_depth,
)
from datagen.train.prediction.ply import read_ply

DEPTH_SCALE_M = 0.001
# Files of a folder that holds one frame.
RGB, DEPTH, INTRINSICS, MASK, POSE = "color.png", "depth.png", "intrinsics.json", "mask.png", "pose.json"


@dataclass(frozen=True)
class Pinhole:
    """Intrinsics in pixels. Pixel (u, v) has its centre at (u, v), as cameras and OpenCV have it."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float

    def points(self, u: I64, v: I64, depth_m: F32) -> F32:
        """Points (N, 3) in the camera's frame, of pixels (N,) with their depths (N,)."""
        x, y = (u - self.cx_px) / self.fx_px, (v - self.cy_px) / self.fy_px
        return (np.stack([x, y, np.ones(len(u))], axis=1) * depth_m[:, None]).astype(np.float32)

    def pixels(self, points_m: F64) -> F64:
        """Pixels (N, 2), u and v, of points (N, 3) in the camera's frame."""
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = points_m[:, 0] / points_m[:, 2], points_m[:, 1] / points_m[:, 2]
        return np.column_stack([self.fx_px * x + self.cx_px, self.fy_px * y + self.cy_px])


@dataclass(frozen=True, eq=False)
class RgbdImage:
    """The picture of a frame; depth is 0 where nothing was measured."""

    rgb: U8  # (H, W, 3)
    depth_m: F32  # (H, W), along the camera's z axis
    pinhole: Pinhole
    mask: Bools | None  # (H, W), the target's pixels

    def points(self, pixels: I64, depth_m: F32 | None = None) -> F32:
        """Points (N, 3) in the camera's frame, of flat pixel indices (N,)."""
        v, u = np.divmod(pixels, self.depth_m.shape[1])
        return self.pinhole.points(u, v, (self.depth_m if depth_m is None else depth_m).ravel()[pixels])

    def cut(self, left: int, top: int, right: int, bottom: int) -> RgbdImage:
        """The part of the picture between these columns and rows, with its pinhole."""
        p, part = self.pinhole, np.s_[top:bottom, left:right]
        pinhole = Pinhole(p.fx_px, p.fy_px, p.cx_px - left, p.cy_px - top)
        mask = None if self.mask is None else self.mask[part]
        return RgbdImage(self.rgb[part], self.depth_m[part], pinhole, mask)

    def facets(self, T: F64) -> F64:
        """Area times normal (H, W, 3) of each pixel of smoothed depth, towards the camera; world frame."""
        known = (self.depth_m > 0).astype(np.float32)
        weight = np.asarray(ndimage.uniform_filter(known, 7), np.float32)
        smooth = np.asarray(ndimage.uniform_filter(self.depth_m, 7), np.float32) / np.maximum(weight, 1e-6)
        grid = self.world_grid(T, smooth.astype(np.float32))
        facets = np.cross(np.gradient(grid, axis=0), np.gradient(grid, axis=1))
        towards = np.einsum("ijk,ijk->ij", facets, T[:3, 3] - grid)
        return facets * np.sign(towards)[..., None]

    def world_grid(self, T: F64, depth_m: F32 | None = None) -> F64:
        """Points (H, W, 3) of all pixels in T's parent frame; those without depth lie at the camera."""
        h, w = self.depth_m.shape
        return moved(self.points(np.arange(h * w), depth_m), T).reshape(h, w, 3)


@dataclass(frozen=True, eq=False)
class SensorFrame:
    """Points in the camera's frame: x right, y down, z forward (OpenCV); None where the input lacks it."""

    place: str
    points_m: F32  # (N, 3)
    rgb: U8  # (N, 3)
    on_target: Bools | None  # (N,)
    T_world_camera: F64 | None  # (4, 4)
    image: RgbdImage | None


def moved(points_m: F32 | F64, T: F64) -> F64:
    """Points (N, 3) moved by a transform (4, 4).

    Written out: a product of a long and a 3x3 matrix costs BLAS ten times as much, most of it in threads.
    """
    x, y, z = (np.ascontiguousarray(points_m[:, k], np.float64) for k in range(3))
    return np.stack([x * T[k, 0] + y * T[k, 1] + z * T[k, 2] + T[k, 3] for k in range(3)], axis=1)


def read_frame(
    rgb: str | Path,
    depth: str | Path,
    intrinsics: str | Path,
    *,
    mask: str | Path | None = None,
    pose: str | Path | None = None,
    depth_scale_m: float = DEPTH_SCALE_M,
) -> SensorFrame:
    """A frame of two aligned images and a JSON file of intrinsics. InputError for bad or unequal files."""
    colour, depth_m = read_rgb(Path(rgb)), read_depth(Path(depth), depth_scale_m)
    fx, fy, cx, cy, width, height = read_intrinsics(Path(intrinsics))
    chosen = None if mask is None else read_mask(Path(mask))
    if (height, width) != depth_m.shape:
        problem = f"is {width}x{height}, but the depth image has {_size(depth_m)}"
        raise InputError(intrinsics, "width, height", problem, "Give the intrinsics of this stream")
    T = None if pose is None else read_pose(Path(pose))
    image = RgbdImage(colour, depth_m, Pinhole(fx, fy, cx, cy), chosen)
    return image_frame(image, T, {"rgb": str(rgb), "depth": str(depth), "mask": str(mask)})


def read_place(place: str | Path, depth_scale_m: float = DEPTH_SCALE_M) -> SensorFrame:
    """The frame of a folder, of an .npz archive or of a .ply cloud.

    A folder holds color.png, depth.png, intrinsics.json, and optionally mask.png and pose.json.
    """
    path = Path(place)
    match path.suffix.lower():
        case ".npz":
            return _npz_frame(path, depth_scale_m)
        case ".ply":
            cloud = read_ply(path)
            return SensorFrame(str(path), cloud.points_m, cloud.rgb, cloud.on_target, None, None)
        case _ if path.is_dir():
            more = [path / name if (path / name).exists() else None for name in (MASK, POSE)]
            files = (path / RGB, path / DEPTH, path / INTRINSICS)
            for file in files:
                if not file.exists():
                    fix = f"A frame's folder has {RGB}, {DEPTH} and {INTRINSICS}"
                    raise InputError(file, "", "is missing", fix)
            return read_frame(*files, mask=more[0], pose=more[1], depth_scale_m=depth_scale_m)
        case _:
            fix = f"Name a folder with {RGB}, {DEPTH} and {INTRINSICS}, an .npz archive or a .ply cloud"
            raise InputError(path, "--frame", "is not a frame", fix)


def image_frame(image: RgbdImage, T_world_camera: F64 | None, sources: dict[str, str]) -> SensorFrame:
    """The frame of an image; `sources` names the files of rgb, depth and mask in errors."""
    where = {name: sources.get(name, name) for name in ("rgb", "depth", "mask")}
    for name, picture in (("rgb", image.rgb), ("mask", image.mask)):
        if picture is not None and picture.shape[:2] != image.depth_m.shape:
            problem = f"has {_size(picture)} pixels, but the depth image {_size(image.depth_m)}"
            fix = "Align colour and depth, and give images of equal size"
            raise InputError(where[name], "", problem, fix)
    pixels = np.flatnonzero(image.depth_m.ravel())
    if not len(pixels):
        fix = "Check the camera's depth stream, and --depth-scale"
        raise InputError(where["depth"], "", "no pixel has depth", fix)
    if image.mask is not None and not image.mask.any():
        raise InputError(where["mask"], "", "selects no pixel", "Mark the target white on black")
    on_target = None if image.mask is None else image.mask.ravel()[pixels]
    colours = image.rgb.reshape(-1, 3)[pixels]
    return SensorFrame(where["depth"], image.points(pixels), colours, on_target, T_world_camera, image)


def _npz_frame(path: Path, depth_scale_m: float) -> SensorFrame:
    arrays = read_arrays(path)
    for name, shape in (("depth", "(H, W)"), ("rgb", "(H, W, 3)"), ("intrinsics", "(4,)")):
        if name not in arrays:
            raise InputError(path, name, "is missing", f"Add it as an array {shape}")
    depth, rgb, numbers = arrays["depth"], arrays["rgb"], arrays["intrinsics"]
    if depth.ndim != 2 or depth.size > MAX_PIXELS or min(depth.shape) < 2:
        raise InputError(path, "depth", f"has shape {depth.shape}", "Give depth as (H, W)")
    if depth.dtype.kind != "f" and depth.dtype != np.uint16:
        fix = "Give uint16 in steps of --depth-scale, or float in metres"
        raise InputError(path, "depth", f"has type {depth.dtype}", fix)
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
        raise InputError(path, "rgb", f"is {rgb.dtype} of shape {rgb.shape}", "Give rgb as uint8 (H, W, 3)")
    if numbers.shape != (4,) or not np.isfinite(numbers).all() or (numbers[:2] < 1).any():
        raise InputError(path, "intrinsics", "are not fx, fy, cx, cy", "Give four numbers, in pixels")
    scale = 1.0 if depth.dtype.kind == "f" else depth_scale_m
    mask = arrays.get("mask")
    if mask is not None and mask.ndim != 2:
        raise InputError(path, "mask", f"has shape {mask.shape}", "Give the mask as (H, W)")
    pose = arrays.get("T_world_camera")
    with np.errstate(over="ignore", invalid="ignore"):
        metres = valid_depth((depth.astype(np.float64) * scale).astype(np.float32))
    fx, fy, cx, cy = (float(n) for n in numbers)
    image = RgbdImage(rgb, metres, Pinhole(fx, fy, cx, cy), None if mask is None else mask.astype(np.bool_))
    T = None if pose is None else checked_pose(pose.astype(np.float64), str(path))
    return image_frame(image, T, {name: f"{path}: {name}" for name in ("rgb", "depth", "mask")})


def _size(picture: npt.NDArray[np.generic]) -> str:
    return f"{picture.shape[1]}x{picture.shape[0]}"

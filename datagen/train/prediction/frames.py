"""Frames of a depth camera: points in the camera frame, with their image."""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import islice
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy import ndimage

from datagen.schemas.errors import InputError
from datagen.train.inputs import F32, F64, I64, U8, Bools
from datagen.train.prediction.files import (
    checked_depth,
    checked_pose,
    read_arrays,
    read_depth,
    read_mask,
    read_pose,
    read_rgb,
    scaled_depth,
)
from datagen.train.prediction.intrinsics import Intrinsics, Pinhole, read_intrinsics
from datagen.train.prediction.pcd import read_pcd
from datagen.train.prediction.ply import read_ply

# Of each file of a frame's folder: its names before the dot, and its endings. The first are the usual ones.
_CAMERA = ("*intrinsics", "*intrinsic", "*camerainfo", "camera", "calibration", "calib", "k")
_FILES: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "color": (("*color", "*colour", "*rgb", "image"), ("png", "jpg", "jpeg", "tif", "tiff", "ppm")),
    "depth": (("*depth",), ("png", "tif", "tiff", "pgm", "npy", "npz")),
    "intrinsics": (_CAMERA, ("json", "yaml", "yml", "txt")),
    "mask": (("mask",), ("png",)),
    "pose": (("pose",), ("json",)),
}
_IN_CACHE = 8192  # points; all at once take twice as long
_LISTED, _MOST_LISTED = 12, 10_000  # files of a folder that an error names, and that are looked at


@dataclass(frozen=True, eq=False)
class RgbdImage:
    """The picture of a frame; depth is 0 where nothing was measured."""

    rgb: U8  # (H, W, 3)
    depth_m: F32  # (H, W), along the camera's z axis
    pinhole: Pinhole
    mask: Bools | None  # (H, W), the target's pixels
    # Where it was undistorted: flat index (H, W) of each pixel in the picture that was given, -1 for none.
    source: I64 | None = None
    step_m: float = 0.0  # metres a step of the stored depth; 0 where it is not from a file
    notes: tuple[str, ...] = ()  # on how the files were read, for the answer

    def points(self, pixels: I64, depth_m: F32 | None = None) -> F32:
        """Points (N, 3) in the camera's frame, of flat pixel indices (N,)."""
        v = pixels // (width := self.depth_m.shape[1])
        flat = (self.depth_m if depth_m is None else depth_m).ravel()
        return self.pinhole.points(pixels - v * width, v, flat[pixels])

    def undistorted(self, camera: Intrinsics) -> RgbdImage:
        """The picture of an ideal pinhole, noted. Depth is the nearest pixel's, never a mean."""
        if (source := camera.source_pixels(*self.depth_m.shape)) is None:
            return self
        note = f"lens distortion ({camera.model or 'Brown-Conrady'}) was undone"
        inside, flat = source >= 0, np.maximum(source, 0)
        rgb = self.rgb.reshape(-1, 3)[flat] * inside[..., None]
        mask = None if self.mask is None else self.mask.ravel()[flat] & inside
        depth_m, notes = self.depth_m.ravel()[flat] * inside, (*self.notes, note)
        return replace(self, rgb=rgb, depth_m=depth_m, mask=mask, source=source, notes=notes)

    def pixel_of(self, u: int, v: int) -> tuple[int, int]:
        """Where pixel (u, v) of the picture that was given lies in this one."""
        if self.source is None:
            return u, v
        rows, columns = np.divmod(self.source, self.source.shape[1])
        gap = np.where(self.source >= 0, (rows - v) ** 2 + (columns - u) ** 2, np.iinfo(np.int64).max)
        row, column = divmod(int(gap.argmin()), self.source.shape[1])
        return column, row

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
    found = np.empty((len(points_m), 3))
    for start in range(0, len(points_m), _IN_CACHE):
        some = slice(start, start + _IN_CACHE)
        x, y, z = (np.ascontiguousarray(points_m[some, k], np.float64) for k in range(3))
        for k in range(3):
            found[some, k] = x * T[k, 0] + y * T[k, 1] + z * T[k, 2] + T[k, 3]
    return found


def read_frame(
    rgb: str | Path,
    depth: str | Path,
    intrinsics: str | Path,
    *,
    mask: str | Path | None = None,
    pose: str | Path | None = None,
    depth_scale: float | None = None,
) -> SensorFrame:
    """An undistorted frame of two aligned images and intrinsics. InputError for bad or unequal files.

    `depth_scale` is in metres a step below 1, else in steps a metre; None chooses it by the depth image.
    """
    colour, stored = read_rgb(Path(rgb)), read_depth(Path(depth))
    camera, (height, width) = read_intrinsics(Path(intrinsics)), stored.shape
    chosen = None if mask is None else read_mask(Path(mask))
    if camera.size_px is not None and camera.size_px != (width, height):
        problem = f"is {camera.size_px[0]}x{camera.size_px[1]}, but the depth image has {_size(stored)}"
        raise InputError(intrinsics, "width, height", problem, "Give the intrinsics of this stream")
    T = None if pose is None else read_pose(Path(pose))
    depth_m, step_m, notes = scaled_depth(stored, depth_scale, depth)
    image = RgbdImage(colour, depth_m, camera.pinhole, chosen, step_m=step_m, notes=notes)
    sources = {"rgb": str(rgb), "depth": str(depth), "mask": str(mask)}
    frame = image_frame(image, T, sources)  # refuses images that do not fit
    undistorted = image.undistorted(camera)
    return frame if undistorted is image else image_frame(undistorted, T, sources)


def read_place(place: str | Path, depth_scale: float | None = None) -> SensorFrame:
    """The frame of a folder, an .npz archive or a .ply or .pcd cloud; `depth_scale` as for `read_frame`.

    A folder holds a colour and a depth image, intrinsics, and optionally a mask and a pose, by usual names.
    """
    path = Path(place)
    match path.suffix.lower():
        case ".npz":
            return _npz_frame(path, depth_scale)
        case ".ply" | ".pcd":
            cloud = read_ply(path) if path.suffix.lower() == ".ply" else read_pcd(path)
            return SensorFrame(str(path), cloud.points_m, cloud.rgb, cloud.on_target, None, None)
        case _ if path.is_dir():
            files = frame_files(path)
            for role in ("color", "depth", "intrinsics"):
                if role not in files:
                    (patterns, endings), has = _FILES[role], _listed(_names(path)) or "no files"
                    fix = f"A frame's folder has {', '.join(patterns)} as .{', .'.join(endings)}"
                    fix += "" if role == "intrinsics" else f", or one image in {patterns[0][1:]}/"
                    raise InputError(path, role, f"is missing: the folder has {has}", fix)
            more = {role: files.get(role) for role in ("mask", "pose")}
            three = (files[role] for role in ("color", "depth", "intrinsics"))
            return read_frame(*three, **more, depth_scale=depth_scale)
        case _:
            fix = "Name a folder with colour, depth and intrinsics, an .npz archive, or a .ply or .pcd cloud"
            raise InputError(path, "--frame", "is not a frame", fix)


def frame_files(folder: Path) -> dict[str, Path]:
    """Files of a frame's folder, by `color`, `depth`, `intrinsics`, `mask` and `pose`.

    A folder `rgb` or `depth` with one image, as of TUM's data sets, stands for it. InputError for several.
    """
    names, found = _names(folder), dict[str, Path]()
    for role, (patterns, endings) in _FILES.items():
        stems, usual = [pattern.removeprefix("*") for pattern in patterns], f"{role}.{endings[0]}"
        like = [name for name in names if _matches(name, patterns, endings)]
        if not like:
            inside = [f"{name}/{each}" for name in names if name in stems for each in _names(folder / name)]
            like = [name for name in inside if name.lower().endswith(endings)]
        exact = [name for name in like if name.partition(".")[0].lower() in stems]
        chosen = [usual] if usual in like else exact or like
        if len(chosen) > 1:
            problem = f"has {len(chosen)}: {_listed(chosen)}"
            raise InputError(folder, role, problem, f"Name the one of this frame {usual}")
        if chosen:
            found[role] = folder / chosen[0]
    return found


def _matches(name: str, patterns: tuple[str, ...], endings: tuple[str, ...]) -> bool:
    stem, _, ending = name.lower().rpartition(".")
    bare = re.sub(r"[^a-z0-9]", "", stem)
    bare = bare.removesuffix("image") or bare
    return ending in endings and any(fnmatchcase(bare, pattern) for pattern in patterns)


def _names(folder: Path) -> list[str]:
    """Sorted names of a folder, a bounded number; none of what is no folder, or cannot be read."""
    try:
        with os.scandir(folder) as entries:
            return sorted(entry.name for entry in islice(entries, _MOST_LISTED))
    except OSError:
        return []


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(names[:_LISTED]) + more


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


def _npz_frame(path: Path, depth_scale: float | None) -> SensorFrame:
    arrays = read_arrays(path)
    for name, shape in (("depth", "(H, W)"), ("rgb", "(H, W, 3)"), ("intrinsics", "(4,)")):
        if name not in arrays:
            raise InputError(path, name, "is missing", f"Add it as an array {shape}")
    depth, rgb, numbers = checked_depth(arrays["depth"], path), arrays["rgb"], arrays["intrinsics"]
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
        raise InputError(path, "rgb", f"is {rgb.dtype} of shape {rgb.shape}", "Give rgb as uint8 (H, W, 3)")
    if numbers.shape == (3, 3):
        numbers = numbers[[0, 1, 0, 1], [0, 1, 2, 2]]
    if numbers.shape != (4,) or not np.isfinite(numbers).all() or (numbers[:2] < 1).any():
        fix = "Give four numbers, in pixels, or K (3, 3)"
        raise InputError(path, "intrinsics", "are not fx, fy, cx, cy", fix)
    mask = arrays.get("mask")
    if mask is not None and mask.ndim != 2:
        raise InputError(path, "mask", f"has shape {mask.shape}", "Give the mask as (H, W)")
    pose = arrays.get("T_world_camera")
    pinhole, marked = Pinhole(*map(float, numbers)), None if mask is None else mask.astype(np.bool_)
    depth_m, step_m, notes = scaled_depth(depth, depth_scale, path)
    image = RgbdImage(rgb, depth_m, pinhole, marked, step_m=step_m, notes=notes)
    T = None if pose is None else checked_pose(pose.astype(np.float64), str(path))
    return image_frame(image, T, {name: f"{path}: {name}" for name in ("rgb", "depth", "mask")})


def write_place(frame: SensorFrame, folder: Path) -> None:
    """Write an undistorted frame as a new folder that `read_place` reads."""
    image, T = frame.image, frame.T_world_camera
    assert image is not None
    folder.mkdir(parents=True)
    Image.fromarray(image.rgb).save(folder / "color.png")
    np.save(folder / "depth.npy", image.depth_m)
    p, (height, width) = image.pinhole, image.depth_m.shape
    numbers = {"fx": p.fx_px, "fy": p.fy_px, "cx": p.cx_px, "cy": p.cy_px, "width": width, "height": height}
    (folder / "intrinsics.json").write_text(json.dumps(numbers))
    if T is not None:
        (folder / "pose.json").write_text(json.dumps({"T_world_camera": T.tolist()}))


def _size(picture: npt.NDArray[np.generic]) -> str:
    return f"{picture.shape[1]}x{picture.shape[0]}"

"""Read intrinsics by content, as ROS, RealSense, Open3D, OpenCV, Azure Kinect and Kalibr write them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular
from datagen.train.inputs import F32, F64, I64
from datagen.workers.image_file import MAX_SIDE_PX
from datagen.workers.json_document import JsonNode, parse_json
from datagen.workers.yaml_file import parse_yaml

_MAX_JSON_BYTES, _MAX_TEXT_BYTES = 2**20, 2**16
_FOCAL_PX, _NUMBER = (1.0, 1e5), (-1e6, 1e6)
_MATRIX = ("K", "k", "camera_matrix", "cameraMatrix", "intrinsic_matrix", "intrinsics", "intrinsic")
_LENS = ("D", "d", "coeffs", "distortion_coefficients", "distortion_coeffs", "dist_coeffs", "distortion")
# The order of OpenCV.
_TERMS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
# Names without other characters than letters and digits, and how many coefficients each kind has.
_KINDS: dict[str, tuple[int, Sequence[str]]] = {
    "brown": (
        12,
        ("", "none", "pinhole", "plumbbob", "brownconrady", "opencv", "radtan", "rationalpolynomial"),
    ),
    "modified": (5, ("inversebrownconrady", "modifiedbrownconrady")),
    "equidistant": (4, ("equidistant", "fisheye", "kannalabrandt", "kannalabrandt4")),
}
_FIX = (
    "Write fx, fy, cx, cy (or ppx, ppy) in pixels as JSON, or a matrix 3x3: K or camera_matrix of ROS or "
    "OpenCV, intrinsic_matrix of Open3D, or nine numbers"
)


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
        found = np.empty((len(u), 3), np.float32)
        found[:, 0], found[:, 1], found[:, 2] = x * depth_m, y * depth_m, depth_m
        return found

    def pixels(self, points_m: F64) -> F64:
        """Pixels (N, 2), u and v, of points (N, 3) in the camera's frame."""
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = points_m[:, 0] / points_m[:, 2], points_m[:, 1] / points_m[:, 2]
        return np.column_stack([self.fx_px * x + self.cx_px, self.fy_px * y + self.cy_px])


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole with the distortion of its lens; `size_px` (width, height) is None where it is not given."""

    place: str
    pinhole: Pinhole
    size_px: tuple[int, int] | None
    model: str  # as the file names it
    coefficients: tuple[float, ...]

    def source_pixels(self, height: int, width: int) -> I64 | None:
        """Flat index (H, W) of the picture's pixel that each pixel of an ideal pinhole shows, -1 for none.

        The pinhole has the same focal lengths, centre and size. None where the lens does not distort.
        InputError where the coefficients leave less than half of the picture.
        """
        kind, d = self._kind()
        if kind != "equidistant" and not d.any():
            return None
        p = self.pinhole
        v, u = np.indices((height, width), np.float64)
        ideal_x, ideal_y = (u - p.cx_px) / p.fx_px, (v - p.cy_px) / p.fy_px
        with np.errstate(all="ignore"):
            x, y = _distorted(kind, d, ideal_x, ideal_y)
            u, v = np.rint(x * p.fx_px + p.cx_px), np.rint(y * p.fy_px + p.cy_px)
            (x_v, x_u), (y_v, y_u) = np.gradient(x), np.gradient(y)
            # Beyond the range of its calibration a polynomial folds the picture over, or mirrors it.
            good = (x_u * y_v - x_v * y_u > 0) & (x * ideal_x + y * ideal_y >= 0)
            good &= (u >= 0) & (u < width) & (v >= 0) & (v < height)
        if good.mean() < 0.5:
            problem = f"({self.model or 'no model'}) leave {good.mean():.0%} of the picture"
            raise InputError(self.place, "distortion coefficients", problem, "Correct them, or their model")
        return np.where(good, np.where(good, v, 0) * width + np.where(good, u, 0), -1).astype(np.int64)

    def _kind(self) -> tuple[str, F64]:
        """The kind of model, and its coefficients (12,), 0 where not given."""
        name = re.sub(r"[^a-z0-9]|rs2|distortion", "", self.model.lower())
        used = len(np.trim_zeros(self.coefficients, "b"))
        kind = next((kind for kind, (_, names) in _KINDS.items() if name in names), "" if used else "brown")
        most = _KINDS[kind][0] if kind else 0
        if used > most:
            problem = f"{self.model} has {used} coefficients" if kind else f"{self.model} is unknown"
            fix = "Undistort the images and give zeros, or use plumb_bob, rational_polynomial or equidistant"
            raise InputError(self.place, "distortion model", problem, fix)
        return kind, np.array([*self.coefficients[:used], *np.zeros(12 - used)])


def _distorted(kind: str, d: F64, x: F64, y: F64) -> tuple[F64, F64]:
    """Where a lens shows points (x, y, 1): Brown-Conrady of OpenCV or librealsense, Kannala-Brandt 2006."""
    r2 = x * x + y * y
    if kind == "equidistant":
        r = np.sqrt(np.maximum(r2, 1e-18))
        angle = np.arctan(r)
        scale = angle * (1 + sum(k * angle ** (2 * n + 2) for n, k in enumerate(d[:4]))) / r
        return x * scale, y * scale
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = d
    scale = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    # The inverse and the modified model of librealsense shift the points that are scaled before.
    a, b = (x * scale, y * scale) if kind == "modified" else (x, y)
    return (
        x * scale + 2 * p1 * a * b + p2 * (r2 + 2 * a * a) + r2 * (s1 + r2 * s2),
        y * scale + 2 * p2 * a * b + p1 * (r2 + 2 * b * b) + r2 * (s3 + r2 * s4),
    )


def read_intrinsics(path: Path) -> Intrinsics:
    """The intrinsics of one camera. InputError for files of none or several, naming the value."""
    data = read_regular(path, _MAX_JSON_BYTES, "Name a readable file of intrinsics of at most 1 MiB")
    if data.lstrip()[:1] in (b"{", b"["):
        node = parse_json(data, str(path))
    elif len(data) > _MAX_TEXT_BYTES or b"\0" in data:
        raise InputError(path, "", "is neither JSON, YAML nor a matrix as text", _FIX)
    else:
        numbers = [_number(word) for word in data.decode("utf-8", "replace").replace(",", " ").split()]
        is_matrix = numbers and not any(isinstance(number, str) for number in numbers)
        node = JsonNode(str(path), "$", numbers if is_matrix else _numbered(parse_yaml(data, path, _FIX)))
    if isinstance(node.value, list):
        node = JsonNode(node.place, "$", {"K": node.value})
    cameras, left = list[JsonNode](), [node]
    while left:
        node = left.pop()
        if isinstance(node.value, dict):
            if {"fx", "fy", "ppx", "ppy"} & node.value.keys() or _numbers(node, _MATRIX, 16) is not None:
                cameras.append(node)
            else:
                left += [node.get(key) for key in node.value]
    if len(cameras) != 1:
        problem, fix = f"has {len(cameras)} cameras", "Give that of the depth image alone"
        raise InputError(path, "", problem if cameras else "has no camera", fix if cameras else _FIX)
    return _camera(cameras[0])


def _camera(node: JsonNode) -> Intrinsics:
    if (matrix := _numbers(node, _MATRIX, 16)) is not None:
        fx, fy, cx, cy = _of_matrix(node, matrix)
    else:
        found = {keys: _first(node, *keys) for keys in (("fx",), ("fy",), ("cx", "ppx"), ("cy", "ppy"))}
        missing = [" or ".join(keys) for keys, value in found.items() if value is None]
        if missing:
            raise InputError(node.place, ", ".join(missing), "missing", _FIX)
        fx, fy, cx, cy = (
            value.number(*(_FOCAL_PX if keys[0][0] == "f" else _NUMBER))
            for keys, value in found.items()
            if value is not None
        )
    given = [_first(node, "width", "image_width", "w"), _first(node, "height", "image_height", "h")]
    if (both := node.find("resolution")) is not None:
        given = [*both.items(2)]
    size = [int(side.number(2, MAX_SIDE_PX)) for side in given if side is not None]
    lens = _numbers(node, _LENS, 14)
    if lens is None:
        lens = [node.given(term, 0).number(*_NUMBER) for term in _TERMS]
    model = _first(node, "distortion_model", "model")
    name = "" if model is None else model.text()
    return Intrinsics(
        node.place, Pinhole(fx, fy, cx, cy), (size[0], size[1]) if len(size) == 2 else None, name, tuple(lens)
    )


def _first(node: JsonNode, *keys: str) -> JsonNode | None:
    return next((n for key in keys if (n := node.find(key)) is not None), None)


def _numbers(node: JsonNode, keys: Sequence[str], most: int) -> list[float] | None:
    """The first list of numbers, or of rows of numbers, by these names; a matrix of OpenCV is its `data`."""
    for n in (n for key in keys if (n := node.find(key)) is not None):
        n = n.find("data") if isinstance(n.value, dict) else n
        if n is not None and isinstance(n.value, list):
            rows = (
                list(item.items(most)) if isinstance(item.value, list) else [item] for item in n.items(most)
            )
            numbers = [cell.number(*_NUMBER) for row in rows for cell in row]
            if len(numbers) > most:
                raise n.error(f"has {len(numbers)} entries, more than {most}", _FIX)
            return numbers
    return None


def _of_matrix(node: JsonNode, numbers: list[float]) -> list[float]:
    """(fx, fy, cx, cy) of these four numbers, or of a matrix 3x3, 3x4 or 4x4, by row or by column."""
    if len(numbers) in (9, 12, 16):
        M = np.array(numbers).reshape(-1, 3 if len(numbers) == 9 else 4)[:3, :3]
        M = M.T if M[2, :2].any() and not M[:2, 2].any() else M
        if abs(M[0, 1]) > 0.5 or M[1, 0] or M[2].tolist() != [0, 0, 1]:
            raise node.error("has no matrix fx 0 cx, 0 fy cy, 0 0 1", _FIX)
        numbers = M[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    if len(numbers) != 4 or not all(_FOCAL_PX[0] <= f <= _FOCAL_PX[1] for f in numbers[:2]):
        raise node.error("has no focal lengths in pixels", _FIX)
    return numbers


def _numbered(value: Any) -> Any:
    """A YAML value in which texts of numbers, as 1e-05, are numbers."""
    if isinstance(value, dict):
        return {str(key): _numbered(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_numbered(each) for each in value]
    return _number(value) if isinstance(value, str) else value


def _number(word: str) -> float | str:
    try:
        return float(word)
    except ValueError:
        return word

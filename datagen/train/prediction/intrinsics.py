"""Read intrinsics of cameras as ROS, RealSense, Open3D, OpenCV, Azure Kinect and Kalibr write them, by content."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular
from datagen.train.inputs import F32, F64, I64
from datagen.workers.json_document import JsonNode, parse_json

MAX_SIDE_PX = 8192
_MAX_JSON_BYTES, _MAX_TEXT_BYTES = 2**20, 2**16
_FOCAL_PX, _CENTRE_PX, _COEFFICIENT = (1.0, 1e5), (-1e5, 1e5), (-1e6, 1e6)
_MATRIX = ("K", "k", "camera_matrix", "cameraMatrix", "intrinsic_matrix", "intrinsics", "intrinsic")
_LENS = (
    "D", "d", "coeffs", "distortion_coefficients", "distortion_coeffs", "dist_coeffs", "distCoeffs", "dist",
    "distortion",
)  # fmt: skip
# The order of OpenCV; its last two tilt the sensor.
_TERMS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty")
_MODELS = {
    "": "brown", "none": "brown", "pinhole": "brown", "plumbbob": "brown", "brownconrady": "brown", "opencv": "brown",
    "radtan": "brown", "rationalpolynomial": "brown", "inversebrownconrady": "modified",
    "modifiedbrownconrady": "modified", "equidistant": "equidistant", "fisheye": "equidistant",
    "kannalabrandt": "equidistant", "kannalabrandt4": "equidistant",
}  # fmt: skip
_FIX = (
    "Write fx, fy, cx, cy (or ppx, ppy) in pixels as JSON, or a 3x3 matrix: K or camera_matrix of ROS or OpenCV, "
    "intrinsic_matrix of Open3D, or nine numbers"
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
        return (np.stack([x, y, np.ones(len(u))], axis=1) * depth_m[:, None]).astype(np.float32)


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
        v, u = np.indices((height, width))
        x, y = (u - p.cx_px) / p.fx_px, (v - p.cy_px) / p.fy_px
        with np.errstate(all="ignore"):
            x, y = _distorted(kind, d, x, y)
            u, v = np.rint(x * p.fx_px + p.cx_px), np.rint(y * p.fy_px + p.cy_px)
            (x_v, x_u), (y_v, y_u) = np.gradient(x), np.gradient(y)
            # Beyond the range of its calibration a polynomial folds the picture over.
            good = (x_u * y_v - x_v * y_u > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        if good.mean() < 0.5:
            problem = f"({self.model or 'no model'}) leave {good.mean():.0%} of the picture"
            raise InputError(self.place, "distortion coefficients", problem, "Correct them, or their model")
        return np.where(good, np.where(good, v, 0) * width + np.where(good, u, 0), -1).astype(np.int64)

    def _kind(self) -> tuple[str, F64]:
        """The kind of model, and its coefficients (14,), 0 where not given."""
        name = re.sub(r"[^a-z0-9]|rs2|distortion", "", self.model.lower())
        d = np.zeros(len(_TERMS))
        d[: len(self.coefficients)] = self.coefficients
        kind = _MODELS.get(name, "" if d.any() else "brown")
        most = {"brown": 12, "modified": 5, "equidistant": 4}
        if not kind or d[most[kind] :].any():
            what = (
                f"{self.model} is unknown" if not kind else f"{self.model} has more than {most[kind]} of them"
            )
            fix = "Undistort the images and give zeros, or use plumb_bob, rational_polynomial or equidistant"
            raise InputError(self.place, "distortion model", what, fix)
        return kind, d


def _distorted(kind: str, d: F64, x: F64, y: F64) -> tuple[F64, F64]:
    """Where a lens shows the points (x, y, 1): Brown-Conrady as OpenCV and librealsense, Kannala-Brandt 2006."""
    r2 = x * x + y * y
    if kind == "equidistant":
        r = np.sqrt(np.maximum(r2, 1e-18))
        angle = np.arctan(r)
        scale = angle * (1 + sum(k * angle ** (2 * n + 2) for n, k in enumerate(d[:4]))) / r
        return x * scale, y * scale
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = d[:12]
    scale = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    # The inverse and the modified model of librealsense shift the points that are scaled before.
    a, b = (x * scale, y * scale) if kind == "modified" else (x, y)
    return (
        x * scale + 2 * p1 * a * b + p2 * (r2 + 2 * a * a) + r2 * (s1 + r2 * s2),
        y * scale + 2 * p2 * a * b + p1 * (r2 + 2 * b * b) + r2 * (s3 + r2 * s4),
    )


def read_intrinsics(path: Path) -> Intrinsics:
    """The intrinsics of one camera. InputError for files of none or several, naming the value."""
    fix = "Name a readable file of intrinsics of at most 1 MiB"
    data = read_regular(path, _MAX_JSON_BYTES, fix)
    if data.lstrip()[:1] in (b"{", b"["):
        node = parse_json(data, str(path))
    elif len(data) > _MAX_TEXT_BYTES or b"\0" in data:
        raise InputError(path, "", "is neither JSON, YAML nor a matrix as text", _FIX)
    else:
        text = data.decode("utf-8", errors="replace")
        numbers = [_scalar(word) for word in text.replace(",", " ").split()]
        matrix = numbers and all(isinstance(number, float) for number in numbers)
        node = JsonNode(str(path), "$", {"K": numbers} if matrix else _yaml(text))
    if isinstance(node.value, list):
        node = JsonNode(node.place, "$", {"K": node.value})
    cameras = list(_cameras(node))
    if len(cameras) != 1:
        problem = "has no camera" if not cameras else f"has {len(cameras)} cameras"
        raise InputError(path, "", problem, _FIX if not cameras else "Give that of the depth image alone")
    return _camera(cameras[0])


def _cameras(node: JsonNode) -> Iterator[JsonNode]:
    """The objects of a document that hold a camera, from the outside to the inside."""
    left = [node]
    while left:
        node = left.pop()
        if isinstance(node.value, dict):
            if {"fx", "fy", "ppx", "ppy"} & node.value.keys() or _first(node, _MATRIX, list) is not None:
                yield node
            else:
                left += [node.get(key) for key in node.value]


def _camera(node: JsonNode) -> Intrinsics:
    if (matrix := _first(node, _MATRIX, list)) is not None:
        fx, fy, cx, cy = _of_matrix(matrix)
    else:
        names = (("fx",), ("fy",), ("cx", "ppx"), ("cy", "ppy"))
        found = [_first(node, keys) for keys in names]
        missing = [" or ".join(keys) for keys, n in zip(names, found, strict=True) if n is None]
        if missing:
            raise InputError(node.place, ", ".join(missing), "missing", _FIX)
        bounds = (_FOCAL_PX, _FOCAL_PX, _CENTRE_PX, _CENTRE_PX)
        fx, fy, cx, cy = (n.number(*b) for n, b in zip(found, bounds, strict=True) if n is not None)
    sides = [_first(node, keys) for keys in (("width", "image_width", "w"), ("height", "image_height", "h"))]
    if (both := _first(node, ("resolution",), list)) is not None:
        sides = [*both.items(2), None, None][:2]
    width, height = (None if side is None else int(side.number(2, MAX_SIDE_PX)) for side in sides)
    lens = _first(node, _LENS, list)
    terms = [node.find(term) for term in _TERMS[:8]]
    given = [0.0 if n is None else n.number(*_COEFFICIENT) for n in terms]
    coefficients = given if lens is None else _flat(lens, len(_TERMS))
    model = _first(node, ("distortion_model", "model"))
    return Intrinsics(
        node.place,
        Pinhole(fx, fy, cx, cy),
        None if width is None or height is None else (width, height),
        "" if model is None else model.text(),
        tuple(coefficients),
    )


def _first(node: JsonNode, keys: Sequence[str], kind: type | None = None) -> JsonNode | None:
    """The first of the members that is there, of a kind; a matrix of OpenCV is its `data`."""
    for key in keys:
        n = node.find(key)
        if n is not None and kind is list and isinstance(n.value, dict):
            n = n.find("data")
        if n is not None and (kind is None or isinstance(n.value, kind)):
            return n
    return None


def _flat(node: JsonNode, most: int) -> list[float]:
    """The numbers of a list, or of a list of rows; at most so many."""
    rows = [list(item.items(most)) if isinstance(item.value, list) else [item] for item in node.items(most)]
    numbers = [cell.number(*_COEFFICIENT) for row in rows for cell in row]
    if len(numbers) > most:
        raise node.error(f"has {len(numbers)} numbers, more than {most}", _FIX)
    return numbers


def _of_matrix(node: JsonNode) -> tuple[float, float, float, float]:
    """(fx, fy, cx, cy) of these four numbers, or of a matrix 3x3, 3x4 or 4x4, by row or by column."""
    n = _flat(node, 16)
    if len(n) in (9, 12, 16):
        side = 3 if len(n) == 9 else 4
        M = np.array(n).reshape(-1, side)[:3, :3]
        M = M.T if M[2, :2].any() and not M[:2, 2].any() else M
        n = [M[0, 0], M[1, 1], M[0, 2], M[1, 2]]
        if abs(M[0, 1]) > 0.5 or M[1, 0] or M[2].tolist() != [0, 0, 1]:
            raise node.error("is not a camera's matrix: fx 0 cx, 0 fy cy, 0 0 1", _FIX)
    if len(n) != 4 or not all(_FOCAL_PX[0] <= f <= _FOCAL_PX[1] for f in n[:2]):
        raise node.error("has no focal lengths in pixels", _FIX)
    fx, fy, cx, cy = (float(number) for number in n)
    return fx, fy, cx, cy


def _yaml(text: str) -> dict[str, Any]:
    """Objects, scalars and lists of numbers of a YAML file; other lines are left out."""
    lines, depth = list[str](), 0
    for line in (line.partition("#")[0].rstrip() for line in text.splitlines()):
        if depth > 0:
            lines[-1] += " " + line
        else:
            lines.append(line)
        depth = max(depth + line.count("[") - line.count("]"), 0)
    root = dict[str, Any]()
    parents, key = [(-1, root)], ""
    for line in lines:
        bare = line.lstrip(" ")
        if bare.startswith("- ") and len(parents) > 1:
            outside = parents[-2][1]
            if not isinstance(outside.get(key), list):
                outside[key] = list[Any]()
            outside[key].append(_scalar(bare[2:]))
        elif match := re.match(r"([A-Za-z_][\w ]*):(?:\s+(.*))?$", bare):
            indent, (key, value) = len(line) - len(bare), match.groups("")
            while parents[-1][0] >= indent:
                parents.pop()
            inside = parents[-1][1]
            if value.startswith("["):
                inside[key] = [_scalar(word) for word in re.sub(r"[\[\],]", " ", value).split()]
            elif value and not value.startswith("!!"):
                inside[key] = _scalar(value)
            else:
                inside[key] = dict[str, Any]()
                parents.append((indent, inside[key]))
    return root


def _scalar(word: str) -> float | str:
    try:
        return float(word)
    except ValueError:
        return word.strip().strip("'\"")

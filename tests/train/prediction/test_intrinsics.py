"""Intrinsics by content, in the files that robots have; distortion is undone, unknown lenses are refused."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from datagen.schemas.errors import InputError
from datagen.train.prediction.frames import SensorFrame, read_frame
from datagen.train.prediction.intrinsics import Intrinsics, Pinhole, read_intrinsics
from datagen.workers.geometry.mesh import F64

PINHOLE = Pinhole(615.5, 616.25, 321.5, 238.75)
K = [615.5, 0.0, 321.5, 0.0, 616.25, 238.75, 0.0, 0.0, 1.0]
D = [0.1, -0.2, 0.001, -0.002, 0.05]
ROWS = [K[:3], K[3:6], K[6:]]
ROS1 = f"""header:
  seq: 3
  frame_id: "camera_color_optical_frame"
height: 480
width: 640
distortion_model: "plumb_bob"
D: {D}
K: {K}
R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
P: [600.0, 0.0, 321.5, 0.0, 0.0, 601.0, 238.75, 0.0, 0.0, 0.0, 1.0, 0.0]
roi:
  height: 0
  width: 0
---
"""
ROS2 = "height: 480\nwidth: 640\ndistortion_model: plumb_bob\n" + "".join(
    f"{name}:\n" + "".join(f"- {number}\n" for number in numbers) for name, numbers in (("d", D), ("k", K))
)
CALIBRATION = f"""image_width: 640
image_height: 480
camera_name: head   # as calibrated
camera_matrix:
  rows: 3
  cols: 3
  data: [{K[0]}, {K[1]}, {K[2]},
         {K[3]}, {K[4]}, {K[5]},
         {K[6]}, {K[7]}, {K[8]}]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: {D}
"""
OPENCV = f"""%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ {", ".join(map(str, K[:5]))},
       {", ".join(map(str, K[5:]))} ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: {D}
"""
KALIBR = f"""cam0:
  camera_model: pinhole
  distortion_coeffs: {D}
  distortion_model: radtan
  intrinsics: [615.5, 616.25, 321.5, 238.75]
  resolution: [640, 480]
"""
SIZE = {"width": 640, "height": 480}
PPX = {"fx": 615.5, "fy": 616.25, "ppx": 321.5, "ppy": 238.75}
KNOWN: dict[str, tuple[str, list[float], bool]] = {
    "ROS 1": (ROS1, D, True),
    "ROS 2": (ROS2, D, True),
    "camera_calibration": (CALIBRATION, D, True),
    "OpenCV": (OPENCV, D, True),
    "Kalibr": (KALIBR, D, True),
    "K.txt": ("\n".join(" ".join(f"{n:.6e}" for n in row) for row in ROWS), [], False),
    "4x4 text": ("615.5 0 321.5 0\n0 616.25 238.75 0\n0 0 1 0\n0 0 0 1\n", [], False),
    "Open3D": (json.dumps({**SIZE, "intrinsic_matrix": np.array(ROWS).T.ravel().tolist()}), [], True),
    "K and D": (json.dumps({"K": ROWS, "D": D}), D, False),
    "rows alone": (json.dumps(ROWS), [], False),
    "RealSense": (json.dumps({**SIZE, **PPX, "model": "distortion.brown_conrady", "coeffs": D}), D, True),
    "in an object": (json.dumps({"color": {**SIZE, **PPX, "coeffs": D}, "serial": "1"}), D, True),
    "Azure Kinect": (json.dumps(PPX | dict(zip(("k1", "k2", "p1", "p2", "k3"), D, strict=True))), D, False),
}  # fmt: skip


@pytest.mark.parametrize("name", KNOWN)
def test_the_files_of_robots_are_read_by_content(name: str, tmp_path: Path) -> None:
    text, coefficients, sized = KNOWN[name]
    (tmp_path / "file").write_text(text)
    found = read_intrinsics(tmp_path / "file")
    assert found.pinhole == PINHOLE
    assert found.size_px == ((640, 480) if sized else None)
    np.testing.assert_array_equal(np.trim_zeros(found.coefficients, "b"), coefficients)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no camera"),
        ("hello: world\n", "no camera"),
        ("\0\1\2", "neither JSON"),
        ("1 2 3", "focal lengths"),
        ("k: " + "[" * 60_000, "no camera|focal|YAML"),
        ("a:\n" * 20_000, "no camera"),
        ("1 " * 1000, "1000 entries"),
        ("k:\n" + "- 1\n" * 15_000, "15000 entries"),
        ("1 0 2 0 1 2 5 5 1", "no matrix fx 0 cx"),
        ("500 3 320 0 500 240 0 0 1", "no matrix fx 0 cx"),
        ("nan 0 320 0 500 240 0 0 1", "nan is not within"),
        ('{"K": [[1, {}]]}', "not a number"),
        (json.dumps({"a": PPX, "b": PPX}), "2 cameras"),
        (json.dumps({**PPX, "D": [0.0] * 15}), "15 entries"),
        (json.dumps({**PPX, "model": 4, "D": D}), "not a string"),
        ('{"a":' * 5000, "too deeply"),
    ],
)  # fmt: skip
def test_other_files_are_refused_in_one_line(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text(text)
    with pytest.raises(InputError, match=words) as refused:
        read_intrinsics(tmp_path / "file")
    assert "\n" not in str(refused.value)


def brown(x: float, y: float, k: list[float], *, shift_scaled: bool = False) -> tuple[float, float]:
    """The formula of OpenCV's documentation; librealsense shifts the scaled point in its inverse model."""
    k1, k2, p1, p2, k3, k4, k5, k6 = [*k, *[0.0] * (8 - len(k))]
    r2 = x**2 + y**2
    scale = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    a, b = (x * scale, y * scale) if shift_scaled else (x, y)
    return x * scale + 2 * p1 * a * b + p2 * (r2 + 2 * a**2), y * scale + p1 * (
        r2 + 2 * b**2
    ) + 2 * p2 * a * b


def fisheye(x: float, y: float, k: list[float]) -> tuple[float, float]:
    r = np.hypot(x, y) + 1e-12
    t = np.arctan(r)
    td = t + k[0] * t**3 + k[1] * t**5 + k[2] * t**7 + k[3] * t**9
    return x * td / r, y * td / r


LENSES: dict[str, tuple[object, list[float]]] = {
    "plumb_bob": (brown, [-0.25, 0.09, 0.002, -0.003, -0.01]),
    "Brown Conrady": (brown, [0.3, -0.1, 0.001, 0.002, 0.02]),
    "rational_polynomial": (brown, [0.3, 0.02, 0.001, 0.0005, 0.005, 0.5, 0.05, 0.003]),
    "Inverse Brown Conrady": (partial(brown, shift_scaled=True), [-0.1, 0.02, 0.02, -0.02, -0.001]),
    "equidistant": (fisheye, [-0.02, 0.01, -0.004, 0.001]),
    "Kannala Brandt4": (fisheye, [0.0, 0.0, 0.0, 0.0]),
}  # fmt: skip
W, H, F = 160, 120, 120.0
NORMAL, OFF_M = np.array([0.3, -0.4, 1.0]), 1.5  # the plane that the camera sees, and a box before it
BOX_M = 0.9


def shown(lens: str) -> tuple[F64, F64]:
    """(depth (H, W) that a camera with the lens has of plane and box, rays (H, W, 2) of its pixels)."""
    model, k = LENSES[lens]
    v, u = np.indices((H, W))
    seen = np.stack([(u - W / 2) / F, (v - H / 2) / F], axis=2)
    rays = seen.copy()
    for _ in range(200):  # Newton's method with the identity as the derivative
        rays += 0.7 * (seen - np.stack(model(*rays.transpose(2, 0, 1), k), axis=2))  # type: ignore[operator]
    np.testing.assert_allclose(np.stack(model(*rays.transpose(2, 0, 1), k), axis=2), seen, atol=1e-6)  # type: ignore[operator]
    depth = OFF_M / (np.concatenate([rays, np.ones((H, W, 1))], axis=2) @ NORMAL)
    box = (np.abs(rays - [0.25, 0.2]) < 0.15).all(axis=2)
    return np.where(box, BOX_M, depth).astype(np.float64), rays.astype(np.float64)


def read(folder: Path, lens: str, depth: F64, model: str | None = None) -> SensorFrame:
    np.save(folder / "depth.npy", depth.astype(np.float32))
    Image.fromarray((np.abs(depth - BOX_M) < 1e-6).astype(np.uint8) * 255).save(folder / "mask.png")
    Image.fromarray(np.zeros((H, W, 3), np.uint8)).save(folder / "rgb.jpg")
    lens_of = {"model": model or lens, "coeffs": LENSES[lens][1]}
    document = {"fx": F, "fy": F, "ppx": W / 2, "ppy": H / 2, "width": W, "height": H, **lens_of}
    (folder / "camera.json").write_text(json.dumps(document))
    names = ("rgb.jpg", "depth.npy", "camera.json")
    rgb, metres, intrinsics = (folder / name for name in names)
    return read_frame(rgb, metres, intrinsics, mask=folder / "mask.png")


@pytest.mark.parametrize("lens", LENSES)
def test_distortion_is_undone_to_half_a_pixel_and_keeps_edges(lens: str, tmp_path: Path) -> None:
    depth, _ = shown(lens)
    frame = read(tmp_path, lens, depth)
    assert frame.image is not None and frame.on_target is not None
    assert any("lens distortion" in note and lens in note for note in frame.image.notes)
    plane, box = frame.points_m[~frame.on_target], frame.points_m[frame.on_target]
    # Each point has the depth of the nearest ray that was measured: it is off by what half a pixel spans.
    half_px_m = plane[:, 2] ** 2 * np.linalg.norm(NORMAL[:2]) * 0.75 / F / OFF_M
    off_m = np.abs(plane @ NORMAL - OFF_M) / NORMAL[2]
    assert (off_m < 2 * half_px_m).mean() > 0.995
    np.testing.assert_allclose(box[:, 2], BOX_M, atol=1e-6)
    low, high = (np.percentile(box[:, :2] / box[:, 2:], q, axis=0) for q in (0, 100))
    np.testing.assert_allclose([low, high], [[0.1, 0.05], [0.4, 0.35]], atol=1.5 / F)
    # Without it, points are off by far more.
    v, u = np.indices((H, W))
    raw = np.stack([(u - W / 2) / F * depth, (v - H / 2) / F * depth, depth], axis=2)[depth != BOX_M]
    assert np.abs(raw @ NORMAL - OFF_M).max() > 2 * off_m.max()


def test_what_a_polynomial_folds_over_or_mirrors_is_left_out() -> None:
    camera = Intrinsics("file", Pinhole(100.0, 100.0, 200.0, 150.0), None, "plumb_bob", (-0.15,))
    source = camera.source_pixels(301, 401)
    assert source is not None
    v, u = np.indices(source.shape)
    r = np.hypot(u - 200, v - 150) / 100
    # The radius grows up to r = 1 / sqrt(0.45), and is 0 again at 1 / sqrt(0.15).
    assert (source[r < 1.47] >= 0).all() and (source[r > 1.52] < 0).all()


def test_a_click_is_a_pixel_of_the_picture_that_was_given(tmp_path: Path) -> None:
    depth, _ = shown("plumb_bob")
    image = read(tmp_path, "plumb_bob", depth).image
    assert image is not None and image.mask is not None
    for u, v in ((5, 5), (80, 60), (150, 110)):
        column, row = image.pixel_of(u, v)
        assert abs(image.depth_m[row, column] - depth[v, u]) < 0.02
    assert max(abs(image.pixel_of(5, 5)[0] - 5), abs(image.pixel_of(5, 5)[1] - 5)) > 2


@pytest.mark.parametrize(
    ("model", "coefficients", "words"),
    [
        ("FTheta", [0.5], "FTheta is unknown"),
        ("double_sphere", [0.5, 0.1], "double_sphere is unknown"),
        ("equidistant", [0.1, 0, 0, 0, 0.2], "has 5 coefficients"),
        ("plumb_bob", [0.1] * 13, "has 13 coefficients"),
        ("plumb_bob", [-5000, 0, 0, 0, 0], "of the picture"),
        ("rational_polynomial", [1e6] * 8, "of the picture"),
    ],
)
def test_lenses_that_cannot_be_undone_are_refused_by_name(
    model: str, coefficients: list[float], words: str, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text(json.dumps({**PPX, "model": model, "coeffs": coefficients}))
    with pytest.raises(InputError, match=words):
        read_intrinsics(tmp_path / "file").source_pixels(480, 640)

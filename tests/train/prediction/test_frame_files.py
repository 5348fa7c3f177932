"""Files of a frame by usual names and formats, and the scale of depth."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from datagen.schemas.errors import InputError
from datagen.train.prediction.files import read_depth
from datagen.train.prediction.frames import read_place

K = "100 0 15.5\n0 100 11.5\n0 0 1\n"
STEPS = np.full((24, 32), 1200, np.uint16) + np.arange(32, dtype=np.uint16)
STEPS[:3] = 0
METRES = (STEPS / 1000).astype(np.float32)
COLOUR = np.zeros((24, 32, 3), np.uint8) + np.array([200, 30, 40], np.uint8)


def write_pgm(file: Path, largest: int) -> None:
    head = f"P5\n# steps of 1 mm\n32 24\n{largest}\n".encode()
    file.write_bytes(head + STEPS.astype(">u2").tobytes())


def frame(folder: Path, color: str = "color.png", depth: str = "depth.png", camera: str = "K.txt") -> Path:
    """A frame with files of these names; depth by their ending."""
    for name in (color, depth, camera):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(COLOUR).save(folder / color)
    (folder / camera).write_text(K)
    match depth.rpartition(".")[2]:
        case "npy":
            np.save(folder / depth, METRES)
        case "npz":
            np.savez(folder / depth, METRES)
        case "tiff":
            Image.fromarray(METRES).save(folder / depth)
        case "pgm":
            write_pgm(folder / depth, 5000)
        case _:
            Image.fromarray(STEPS).save(folder / depth)
    return folder


@pytest.mark.parametrize(
    "names",
    [
        ("rgb.jpg", "depth.tiff", "camera_info.yaml"),
        ("colour.tiff", "depth.tif", "intrinsics.yaml"),
        ("image.ppm", "depth.npy", "camera.json"),
        ("rgb/1305031.png", "depth/1305032.png", "camera_intrinsic.txt"),
        ("000012.color.jpg", "000012.depth.pgm", "k.txt"),
        ("color_image.png", "depth_image.png", "rgb_camera_info.yaml"),
        ("RGB.PNG", "head_depth.npz", "camera-info.yml"),
    ],
)
def test_usual_names_and_formats_give_the_same_frame(names: tuple[str, str, str], tmp_path: Path) -> None:
    found = read_place(frame(tmp_path, *names))
    assert found.image is not None
    np.testing.assert_allclose(found.image.depth_m, METRES, atol=1e-6)
    assert np.abs(found.image.rgb.astype(int) - COLOUR).max() < 6
    assert found.image.pinhole.fx_px == 100


def test_the_usual_name_comes_first_and_several_others_are_refused(tmp_path: Path) -> None:
    frame(tmp_path)
    Image.fromarray(STEPS + 100).save(tmp_path / "raw_depth.png")
    assert read_place(tmp_path).points_m[0, 2] == pytest.approx(1.2)
    (tmp_path / "depth.png").rename(tmp_path / "second_depth.png")
    with pytest.raises(InputError, match=r"depth: has 2: raw_depth.png, second_depth.png\. Name the one"):
        read_place(tmp_path)
    tum = frame(tmp_path / "tum", "rgb/1.png", "depth/2.png")
    Image.fromarray(STEPS).save(tum / "depth" / "3.png")
    with pytest.raises(InputError, match=r"depth: has 2: depth/2.png, depth/3.png"):
        read_place(tum)


@pytest.mark.parametrize(
    ("gone", "words"),
    [
        ("color.png", r"color: is missing: the folder has K\.txt, depth\.png\. .*rgb, image.*\.jpg.*color/"),
        ("depth.png", r"depth: is missing: the folder has K\.txt, color\.png\. .*depth.*\.tiff.*depth/"),
        ("K.txt", r"intrinsics: is missing: the folder has color\.png, depth\.png\. .*camerainfo.*\.yaml"),
    ],
)
def test_an_error_lists_what_the_folder_has_and_the_names(gone: str, words: str, tmp_path: Path) -> None:
    (frame(tmp_path) / gone).unlink()
    with pytest.raises(InputError, match=words):
        read_place(tmp_path)


def test_folders_of_many_files_and_of_odd_names_give_one_line(tmp_path: Path) -> None:
    for n in range(40):
        (tmp_path / f"{n}\n.bin").touch()
    (tmp_path / os.fsdecode(b"\xff.png")).touch()
    with pytest.raises(InputError, match="and 29 more") as refused:
        read_place(tmp_path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("largest", [1231, 4095, 10_000, 65_535])
def test_values_of_a_pgm_are_as_stored(largest: int, tmp_path: Path) -> None:
    write_pgm(frame(tmp_path, depth="depth.pgm") / "depth.pgm", largest)
    image = read_place(tmp_path).image
    assert image is not None
    np.testing.assert_array_equal(np.rint(image.depth_m * 1000), STEPS)


@pytest.mark.parametrize(
    ("depth", "scale", "step_m"),
    [
        (STEPS, None, 0.001),
        (STEPS, 0.001, 0.001),
        (STEPS, 1000, 0.001),
        (STEPS * 5, 5000, 0.0002),
        (STEPS * 10, 10_000, 0.0001),
        (METRES, None, 1.0),
        (METRES, 1, 1.0),
        (METRES * 1000, None, 0.001),
        (np.where(STEPS > 0, METRES, np.nan), None, 1.0),
        (np.where(STEPS > 0, METRES * 1000, np.inf), None, 0.001),
    ],
)
def test_depth_is_scaled_as_given_or_by_its_median(
    depth: np.ndarray, scale: float | None, step_m: float, tmp_path: Path
) -> None:
    np.save(frame(tmp_path) / "depth.npy", depth)
    (tmp_path / "depth.png").unlink()
    image = read_place(tmp_path, scale).image
    assert image is not None and image.step_m == step_m
    np.testing.assert_allclose(image.depth_m, METRES, atol=1e-6)
    noted = any(f"steps of {step_m:g} m" in note and "median 1.2" in note for note in image.notes)
    assert noted == (scale is None and depth.dtype.kind == "f" and step_m != 1)  # guessed by the median


@pytest.mark.parametrize(
    ("depth", "scale", "words"),
    [
        (METRES * 1000, 1, r"1216 m at 1 m a step.*--depth-scale 1000 \(median 1.22 m\)"),
        (STEPS * 16, None, r"19.45 m at 0.001 m a step \(16-bit numbers\).*5000 \(.*10000 \(median 1.94 m\)"),
        (STEPS, 1e-6, r"--depth-scale 1e-06.*Give --depth-scale 1000"),
        (METRES, 0.001, r"0.001215 m.*Give --depth-scale 1 \(median 1.22 m\)"),
        (METRES * 1e-30, None, r"Check the camera's depth stream"),
        (STEPS * 0, None, "no pixel has depth"),
        (np.full((24, 32), np.nan), None, "no pixel has depth"),
        (np.full((24, 32), 3e38) * 10, None, "Check the camera's depth stream"),
        (STEPS.astype(np.int32), None, "has type int32"),
        (STEPS[None], None, "has shape"),
    ],
)
def test_a_scale_that_cannot_be_is_refused_with_those_that_fit(
    depth: np.ndarray, scale: float | None, words: str, tmp_path: Path
) -> None:
    np.save(frame(tmp_path) / "depth.npy", depth)
    (tmp_path / "depth.png").unlink()
    with pytest.raises(InputError, match=words):
        read_place(tmp_path, scale)


def test_a_pgm_with_a_long_comment_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "depth.pgm"
    write_pgm(file, 5000)
    file.write_bytes(file.read_bytes().replace(b"1 mm", b"1 mm" * 5000))
    with pytest.raises(InputError, match="Leave out its comments"):
        read_depth(file)


def test_masks_and_poses_of_other_names_are_left_out(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((24, 32), np.uint8)).save(frame(tmp_path) / "old_mask.png")
    (tmp_path / "robot_pose.json").write_text("{}")
    found = read_place(tmp_path)
    assert found.on_target is None and found.T_world_camera is None


@pytest.mark.parametrize("compression", [None, "tiff_lzw"])
def test_changed_bytes_of_a_tiff_give_an_image_or_one_line(compression: str | None, tmp_path: Path) -> None:
    file = tmp_path / "depth.tiff"
    Image.fromarray(STEPS[3:9, :6]).save(file, compression=compression)
    good, refused = file.read_bytes(), 0
    for at in range(len(good)):
        for bit in (0x01, 0x04, 0x80):
            file.write_bytes(good[:at] + bytes([good[at] ^ bit]) + good[at + 1 :])
            try:
                read_depth(file)
            except InputError as error:
                refused += 1
                assert "\n" not in str(error)
    assert refused > 50


HEAD = "VERSION 0.7\nFIELDS x y z rgb _ target\nSIZE 4 4 4 4 1 1\nTYPE F F F {} U U\nCOUNT 1 1 1 1 3 1\n"
COUNT = "WIDTH {w}\nHEIGHT {h}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\n"


@pytest.mark.parametrize("kind", ["F", "U"])
@pytest.mark.parametrize("form", ["ascii", "binary"])
@pytest.mark.parametrize("organised", [False, True])
def test_clouds_of_pcl(kind: str, form: str, organised: bool, tmp_path: Path) -> None:
    packed = np.array([0xC81E28, 0x000001, 0xFFFFFF, 0x204060], np.uint32)
    row = np.dtype([("p", "<f4", 3), ("rgb", "<f4" if kind == "F" else "<u4"), ("_", "u1", 3), ("t", "u1")])
    rows = np.zeros(4, row)
    rows["p"] = [[0.1, 0.2, 1], [np.nan] * 3, [0.3, 0.4, 2], [0.5, 0.6, 3]]
    rows["rgb"], rows["t"] = packed.view(row["rgb"]), [1, 0, 0, 1]
    w, h = (2, 2) if organised else (4, 1)
    head = (HEAD.format(kind) + COUNT.format(w=w, h=h, n=4) + f"DATA {form}\n").encode()
    text = "".join(
        f"{r['p'][0]} {r['p'][1]} {r['p'][2]} {np.float64(r['rgb']):.17g} 0 0 0 {r['t']}\n" for r in rows
    )
    (tmp_path / "a.pcd").write_bytes(head + (rows.tobytes() if form == "binary" else text.encode()))
    cloud = read_place(tmp_path / "a.pcd")
    np.testing.assert_allclose(cloud.points_m, rows["p"][[0, 2, 3]])
    np.testing.assert_array_equal(cloud.rgb, [[200, 30, 40], [255, 255, 255], [32, 64, 96]])
    assert cloud.on_target is not None and cloud.on_target.tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"solid", "not that of a PCD"),
        (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 9\nDATA binary_compressed\n", "is binary_compressed"),
        (b"FIELDS x y z\nSIZE 4 4\nTYPE F F F\nPOINTS 9\nDATA binary\n", "do not agree"),
        (b"FIELDS x y z\nSIZE 3 4 4\nTYPE F F F\nPOINTS 9\nDATA binary\n", "do not agree"),
        (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 9999\nPOINTS 9\nDATA binary\n", "do not agree"),
        (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 0 1\nPOINTS 9\nDATA binary\n", "no field y"),
        (b"FIELDS x y\nSIZE 4 4\nTYPE F F\nPOINTS 9\nDATA binary\n", "no field z"),
        (b"FIELDS x y z x\nSIZE 4 4 4 4\nTYPE F F F F\nPOINTS 9\nDATA ascii\n", "named twice"),
        (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 99999999999\nDATA binary\n", "99,999,999,999"),
        (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS -1\nDATA binary\n", "not a number"),
        (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 0\nDATA binary\n", "no vertices"),
        (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 9\nDATA binary\n123", "0 of 9"),
        (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 1\nDATA ascii\n1 nan 3\n", "none is finite"),
    ],
)
def test_bad_clouds_of_pcl_are_refused(data: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_bytes(data)
    with pytest.raises(InputError, match=words):
        read_place(tmp_path / "a.pcd")

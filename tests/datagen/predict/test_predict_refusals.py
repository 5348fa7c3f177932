"""What `datagen predict` refuses, each in one line: files, options, and frames without depth."""

from __future__ import annotations

import io
import json
import os
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.datagen.predict.frames import arguments, frame_with, pictures
from tests.refusals import refused
from tests.small_runs import files_of


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def write_png(file: Path, width: int, height: int) -> None:
    """A PNG of a few bytes that claims a size."""
    header = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    parts = chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(b"\0" * 1000)), chunk(b"IEND", b"")
    file.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


def write_npy(file: Path, data: bytes) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("depth.npy", data)


def npy_header(dtype: str, shape: tuple[int, ...]) -> bytes:
    """The first bytes of an array's file, which promise so much."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": dtype, "fortran_order": False, "shape": shape})
    return file.getvalue()


def bad_files(folder: Path) -> None:
    """Files of every kind that must be refused."""
    size = (240, 320)
    Image.fromarray(np.zeros(size, np.uint8)).save(folder / "black.png")
    Image.fromarray(np.full((120, 160), 255, np.uint8)).save(folder / "small.png")
    Image.fromarray(np.zeros(size, np.uint16)).save(folder / "nothing.png")
    (folder / "cut.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"\0" * 40)
    write_png(folder / "huge.png", 100_000, 100_000)
    numbers = {"fx": 307.5, "fy": 307.5, "cx": 159.5, "cy": 119.5, "width": 320, "height": 240}
    for name, change in (
        ("keys", {"fx": None, "width": None}),
        ("other", {"width": 640}),
        ("words", {"fx": "wide"}),
        ("nan", {"cx": float("nan")}),
    ):
        (folder / f"{name}.json").write_text(json.dumps({**numbers, **change}))
    (folder / "list.json").write_text("[1, 2")
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 1.0
    poses = {
        "pose_identity": np.eye(4),
        "pose_nan": T * np.nan,
        "pose_mirror": T * [[-1], [1], [1], [1]],
        "pose_wide": T * 2,
    }
    for name, pose in poses.items():
        (folder / f"{name}.json").write_text(json.dumps({"T_world_camera": pose.tolist()}))
    (folder / "pose_rows.json").write_text(json.dumps([[1, 0, 0], [0, 1, 0]]))

    vertex = "property float x\nproperty float y\nproperty float z\n"
    for name, head, body in (
        ("none", "format ascii 1.0\nelement vertex 0\n" + vertex, b""),
        ("many", "format binary_little_endian 1.0\nelement vertex 1000000000000\n" + vertex, b"\0" * 100),
        ("short", "format binary_little_endian 1.0\nelement vertex 1000000\n" + vertex, b"\0" * 100),
        ("flat", "format ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n", b"0 0\n"),
        ("words", "format ascii 1.0\nelement vertex 2\n" + vertex, b"1 2 3\n1 b 3 \n"),
        ("lists", "format ascii 1.0\nelement vertex 2\nproperty list uchar int x\n", b"1 2\n"),
        ("minus", "format ascii 1.0\nelement vertex -2\n" + vertex, b"1 2\n"),
    ):
        (folder / f"{name}.ply").write_bytes(b"ply\n" + head.encode() + b"end_header\n" + body)
    (folder / "noply.ply").write_text("solid\n")

    np.savez(folder / "objects.npz", depth=np.array([{}, 1], object), allow_pickle=True)
    np.savez(folder / "other.npz", colours=np.zeros(3))
    np.savez(folder / "norgb.npz", depth=np.ones((4, 4), np.uint16))
    write_npy(folder / "claim.npz", npy_header("<f4", (1_000_000, 1_000_000)))
    write_npy(folder / "bomb.npz", npy_header("|u1", (70_000_000,)) + bytes(70_000_000))
    write_npy(folder / "junk.npz", b"junk")
    (folder / "noarchive.npz").write_text("no archive")
    with zipfile.ZipFile(folder / "records.npz", "w") as archive:
        for number in range(10_001):
            archive.writestr(f"{number}.npy", b"")
    with open(folder / "sparse.npz", "wb") as file:
        file.truncate(2**40)
    for name in ("fifo", "fifo.npz", "fifo.png", "fifo.json"):
        os.mkfifo(folder / name)
    for name in ("zero.npz", "zero.png"):
        (folder / name).symlink_to("/dev/zero")
    (folder / "crowd").mkdir()


# The file of the frame that is changed, its value, and words of the refusal. `-` leaves it out.
REFUSED_FILES: list[tuple[str, str, str]] = [
    ("mask", "black.png", "selects no pixel"),
    ("mask", "small.png", "160x120"),
    ("color", "small.png", "160x120"),
    ("depth", "black.png", "16-bit"),
    ("depth", "nothing.png", "no pixel has depth"),
    ("depth", "huge.png", "pixels"),
    ("depth", "cut.png", "not a readable"),
    (
        "depth",
        "-",
        "depth: is missing: the folder has color.png, intrinsics.json, mask.png. A frame's folder has",
    ),
    ("depth", "crowd", "not a file"),
    ("intrinsics", "-", "is missing: the folder has color.png, depth.png, mask.png. A frame's folder has"),
    ("intrinsics", "keys.json", "fx: missing"),
    ("intrinsics", "other.json", "640x240"),
    ("intrinsics", "words.json", "fx"),
    ("intrinsics", "nan.json", "cx"),
    ("intrinsics", "list.json", "not JSON"),
    ("mask", "-", "--click"),
    ("pose", "pose_nan.json", "nan is not within"),
    ("pose", "pose_mirror.json", "rotation"),
    ("pose", "pose_wide.json", "rotation"),
    ("pose", "pose_rows.json", "four"),
    (
        "pose",
        "pose_identity.json",
        "looks up at 90 degrees. Give T_world_camera of the camera's optical axes (x",
    ),
    *((name, "fifo.png", "not a file") for name in ("color", "depth", "mask")),
    ("depth", "zero.png", "not a file"),
    ("intrinsics", "fifo.json", "not a file"),
    ("pose", "fifo.json", "not a file"),
]
# The option that is changed, its value, and words of the refusal. `-` leaves the option out.
REFUSED: list[tuple[str, str, str]] = [
    ("--frame", "-", "--frame: is missing"),
    ("--camera-height", "-", "--camera-height"),
    ("--camera-height", "-1", "--camera-height"),
    ("--camera-height", "1.9", "--camera-height"),
    ("--base-height", "nan", "--base-height"),
    ("--reach", "900", "metres"),
    ("--depth-scale", "0", "--depth-scale"),
    ("--depth-scale", "nan", "--depth-scale"),
    ("--depth-scale", "5000", "Give --depth-scale 1000"),
    ("--gravity", "0,0,0", "--gravity"),
    ("--gravity", "0,1", "--gravity"),
    ("--gravity", "0,nan,1", "--gravity"),
    ("--gravity", "0,-9.8,0", "sign"),
    ("--click", "10,10", "is given for a frame with a mask"),
    ("--box", "10,10,30,30", "is given for a frame with a mask"),
    ("--box", "10,10,30", "is no box"),
    ("--frame", "{bad}/missing", "--frame"),
    ("--frame", "{bad}/none.ply", "no vertices"),
    ("--frame", "{bad}/many.ply", "1,000,000,000,000"),
    ("--frame", "{bad}/short.ply", " vertices"),
    ("--frame", "{bad}/flat.ply", "no property z"),
    ("--frame", "{bad}/words.ply", "numbers"),
    ("--frame", "{bad}/lists.ply", "is not valid"),
    ("--frame", "{bad}/minus.ply", "-2"),
    ("--frame", "{bad}/noply.ply", "that of a PLY"),
    ("--frame", "{bad}/objects.npz", "object"),
    ("--frame", "{bad}/other.npz", "has none of"),
    ("--frame", "{bad}/norgb.npz", "rgb"),
    ("--frame", "{bad}/claim.npz", " bytes"),
    ("--frame", "{bad}/bomb.npz", "unpacks"),
    ("--frame", "{bad}/junk.npz", "not an array"),
    ("--frame", "{bad}/noarchive.npz", "not a .npz"),
    ("--frame", "{bad}/records.npz", "not a .npz"),
    ("--frame", "{bad}/sparse.npz", "more than the 268,435,456 allowed"),
    ("--frame", "{bad}/fifo", "not a frame"),
    ("--frame", "{bad}/fifo.npz", "not a file"),
    ("--frame", "{bad}/zero.npz", "not a file"),
    ("--out", "{bad}/a.jpg", ".png"),
    ("--out", "{bad}/missing/a.png", "folder"),
    ("--out", "{made}/frame/color.png", "file of the input"),
    ("--html", "{bad}/a.png", ".html"),
]


@pytest.fixture(scope="module")
def bad(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bad")
    bad_files(folder)
    return folder


@pytest.mark.parametrize(("option", "value", "words"), REFUSED, ids=lambda v: str(v)[-24:])
def test_bad_input_is_refused_in_one_line(
    option: str, value: str, words: str, made: Path, bad: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = files_of(made)
    given = value.format(made=made, bad=bad)
    drop = (option,) if value == "-" else ()
    refused(arguments(made, option, given, drop=drop), capsys, words)
    assert files_of(made) == before


@pytest.mark.parametrize(("name", "value", "words"), REFUSED_FILES, ids=str)
def test_bad_files_of_a_frame_are_refused_in_one_line(
    name: str, value: str, words: str, made: Path, bad: Path, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    frame = frame_with(made / "frame", tmp_path, **{name: None if value == "-" else bad / value})
    refused(arguments(made, "--frame", frame), capsys, words)


def test_several_frames_need_poses(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames = ["--frame", str(made / "frame"), "--frame", str(made / "posed")]
    refused([*arguments(made, drop=("--frame",)), *frames], capsys, "pose: missing")


@pytest.mark.parametrize(
    ("click", "words"), [("320,10", "outside"), ("4,x", "u,v"), ("9", "u,v"), ("60,50", "no depth")]
)
def test_a_click_that_hits_nothing(
    click: str, words: str, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    depth, _ = pictures(made)
    depth[40:60, 50:70] = 0
    frame = frame_with(made / "frame", tmp_path, depth=depth, mask=None)
    refused(arguments(made, "--frame", frame, "--click", click), capsys, "--click", words)


def test_a_target_without_depth_is_refused(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    depth, mask = pictures(made)
    depth[mask & (np.random.default_rng(0).random(mask.shape) < 0.9)] = 0
    frame = frame_with(made / "frame", tmp_path, depth=depth)
    refused(arguments(made, "--frame", frame), capsys, "pixels have depth", "add frames")


def test_a_floor_out_of_sight_is_asked_for(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    depth, _ = pictures(made)
    pose = np.array(json.loads((made / "posed" / "pose.json").read_text())["T_world_camera"])
    n = json.loads((made / "frame" / "intrinsics.json").read_text())
    v, u = np.indices(depth.shape)
    rays = np.stack([(u - n["ppx"]) / n["fx"], (v - n["ppy"]) / n["fy"], np.ones(depth.shape)], axis=2)
    height = (rays * (depth / 1000)[..., None]) @ pose[2, :3] + pose[2, 3]
    depth[height < 0.3] = 0
    frame = frame_with(made / "frame", tmp_path, depth=depth)
    refused(arguments(made, "--frame", frame), capsys, "floor", "--gravity")

"""`datagen predict` as a user meets it: what it writes, and what it refuses in one line."""

from __future__ import annotations

import io
import json
import os
import re
import struct
import sys
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
from PIL import Image

from datagen import cli
from tests.refusals import refused
from tests.small_runs import files_of, json_of
from tests.train.prediction.checkpoints import stored_with, write_untrained
from tests.train.prediction.seen_scenes import MODEL, draw_seen, write_frame

HEIGHT_M = 0.8197  # the scene's camera above the floor


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a frame without and with its pose, and a checkpoint. Tests only read it."""
    folder = tmp_path_factory.mktemp("predict")
    seen = draw_seen(0)
    assert seen.height_m == pytest.approx(HEIGHT_M, abs=0.01)
    write_frame(folder / "frame", seen, posed=False)
    write_frame(folder / "posed", seen)
    write_untrained(folder / "model.ckpt", MODEL)
    return folder


def arguments(folder: Path, *more: str, drop: tuple[str, ...] = ()) -> list[str]:
    """A whole command line, with options left out, replaced or added."""
    chosen = {
        "--frame": str(folder / "frame"),
        "--camera-height": str(HEIGHT_M),
        "--base-height": "0.7",
        "--reach": "0.9",
    }
    chosen |= dict(zip(more[::2], more[1::2], strict=True))
    pairs = [text for name, value in chosen.items() if name not in drop for text in (name, value)]
    return ["predict", str(folder / "model.ckpt"), *pairs]


def frame_with(source: Path, folder: Path, **files: Path | np.ndarray | None) -> str:
    """A copy of a frame in which files are replaced, by name before the dot, or left out."""
    frame = folder / "changed"
    frame.mkdir()
    for path in source.iterdir():
        if path.stem not in files:
            (frame / path.name).symlink_to(path)
    endings = {"intrinsics": ".json", "pose": ".json"}
    for name, content in files.items():
        if isinstance(content, np.ndarray):
            Image.fromarray(content).save(frame / f"{name}.png")
        elif content is not None:
            (frame / f"{name}{endings.get(name, '.png')}").symlink_to(content)
    return str(frame)


def test_an_answer_as_json_picture_and_page(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, page = tmp_path / "a.png", tmp_path / "a.html"
    answer = json_of(capsys, arguments(made, "--out", str(out), "--html", str(page)))
    assert len(answer["candidates"]) == 625 and answer["best"]["state"] == "clear"
    scores = [c["score"] for c in answer["candidates"] if c["state"] == "clear"]
    assert answer["best"]["score"] == max(scores)
    T = np.array(answer["T_world_camera"][0]) @ answer["best"]["T_camera_base"]
    np.testing.assert_allclose(T, answer["best"]["T_world_base"], atol=1e-9)
    assert T[2, 3] == pytest.approx(0.7)
    assert "ahead" in answer["world"] and answer["floor"]["residual_m"] < 0.02
    with Image.open(out) as image:
        pixels = np.asarray(image.convert("RGB")).astype(np.int64)
    assert (np.abs(pixels - (255, 196, 0)).max(axis=2) < 8).sum() > 200  # the gold pose
    text = page.read_text()
    for words in ('<html lang="en">', 'name="viewport"', "<title>Base poses scored by", "color-scheme: dark"):
        assert words in text
    # The view begins behind the camera, which is at y = 0 and looks ahead along y.
    eye = re.search(r'"eye":\{"x":([-.\d]+),"y":([-.\d]+)', text)
    assert eye is not None and abs(float(eye[1])) < 0.5 and float(eye[2]) < -2
    assert "Plotly.newPlot" in text and "score 0." in text and 'src="http' not in text
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.html", "a.png"]


def test_a_click_and_the_same_frame_as_folder_archive_and_cloud(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frame = made / "posed"
    pose = json.loads((frame / "pose.json").read_text())["T_world_camera"]
    mask = np.asarray(Image.open(frame / "mask.png")) > 0
    depth = np.asarray(Image.open(frame / "depth.png"))
    rgb = np.asarray(Image.open(frame / "color.png"))
    numbers = json.loads((frame / "intrinsics.json").read_text())
    four = np.array([numbers[k] for k in ("fx", "fy", "ppx", "ppy")])
    np.savez(tmp_path / "a.npz", rgb=rgb, depth=depth, mask=mask, intrinsics=four, T_world_camera=pose)
    v, u = np.nonzero(depth)
    z = depth[v, u] / 1000
    xyz = np.stack([(u - four[2]) / four[0] * z, (v - four[3]) / four[1] * z, z], axis=1)
    rows = np.zeros(len(z), [("p", "<f4", 3), ("c", "u1", 3), ("target", "u1")])
    rows["p"], rows["c"], rows["target"] = xyz, rgb[v, u], mask[v, u]
    names = [*(f"float {a}" for a in "xyz"), *(f"uchar {c}" for c in ("red", "green", "blue", "target"))]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(z)}"]
    head += [f"property {name}" for name in names] + ["element face 0", "end_header", ""]
    (tmp_path / "a.ply").write_bytes("\n".join(head).encode() + rows.tobytes())

    rest = ["--base-height", "0.7", "--reach", "0.9", "--robot-camera-height", "1.2"]
    # Without hand poses, whose clearances are in cells, so that rounded depths could change them by one.
    checkpoint = str(tmp_path / "model.ckpt")
    write_untrained(tmp_path / "model.ckpt", MODEL | {"hand_poses": 0})
    x, y, z = (-np.array(pose)[2, :3]).tolist()
    level = ["--gravity", f"{x},{y},{z}", "--camera-height", str(pose[2][3])]
    answers = {
        "folder": ["--frame", str(frame)],
        "npz": ["--frame", str(tmp_path / "a.npz")],
        "ply": ["--frame", str(tmp_path / "a.ply"), *level],
        "click": ["--frame", frame_with(frame, tmp_path, mask=None)],
    }
    middle = np.argmin((v - np.nonzero(mask)[0].mean()) ** 2 + (u - np.nonzero(mask)[1].mean()) ** 2)
    answers["click"] += ["--click", f"{u[middle]},{v[middle]}"]
    found = {name: json_of(capsys, ["predict", checkpoint, *given, *rest]) for name, given in answers.items()}
    whole, cloud = found["folder"], found.pop("ply")
    assert cloud["target"]["center_m"][2] == pytest.approx(whole["target"]["center_m"][2], abs=1e-5)
    for name, answer in found.items():
        gap = np.subtract(answer["target"]["center_m"], whole["target"]["center_m"])
        assert np.linalg.norm(gap) < (0.01 if name == "click" else 1e-5), name
    ours, theirs = ([c["score"] for c in a["candidates"]] for a in (found["npz"], whole))
    np.testing.assert_allclose(ours, theirs, atol=1e-4)
    assert np.ptp(theirs) > 0.1
    assert found["click"]["target"]["mask_pixels"] == pytest.approx(mask.sum(), rel=0.15)


def test_a_frame_without_a_clear_place_ends_with_1(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(arguments(made, "--footprint", "2")) == 1
    told = capsys.readouterr().out
    assert "no answer" in told and "0 clear" in told


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
    T = np.eye(4)
    T[2, 3] = 1.0
    poses = {"pose_nan": T * np.nan, "pose_mirror": T * [[-1], [1], [1], [1]], "pose_wide": T * 2}
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
    ("depth", "-", "is missing. A frame's folder has color.png"),
    ("depth", "crowd", "not a file"),
    ("intrinsics", "-", "is missing. A frame's folder has color.png"),
    ("intrinsics", "keys.json", "fx, width"),
    ("intrinsics", "other.json", "640x240"),
    ("intrinsics", "words.json", "fx"),
    ("intrinsics", "nan.json", "cx"),
    ("intrinsics", "list.json", "not JSON"),
    ("mask", "-", "--click"),
    ("pose", "pose_nan.json", "nan is not within"),
    ("pose", "pose_mirror.json", "rotation"),
    ("pose", "pose_wide.json", "rotation"),
    ("pose", "pose_rows.json", "four"),
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
    ("--gravity", "0,0,0", "--gravity"),
    ("--gravity", "0,1", "--gravity"),
    ("--gravity", "0,nan,1", "--gravity"),
    ("--gravity", "0,-9.8,0", "sign"),
    ("--click", "10,10", "is given for a frame with a mask"),
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
    ("--out", "{made}/frame/color.png", "picture of the frame"),
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


def pictures(made: Path) -> tuple[np.ndarray, np.ndarray]:
    """Depth and mask of the frame, to be changed."""
    depth, mask = (np.array(Image.open(made / "frame" / f"{name}.png")) for name in ("depth", "mask"))
    return depth, mask > 0


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


@pytest.mark.parametrize("json_too", [False, True])
@pytest.mark.parametrize(
    ("value", "words"), [(np.nan, "NaN or infinite"), (3e38, "is not finite for sample")]
)
def test_a_model_without_finite_scores_gives_no_answer(
    made: Path, tmp_path: Path, value: float, words: str, json_too: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = safetensors.torch.load_file(made / "model.ckpt")
    filled = {name: torch.full_like(tensor, value) for name, tensor in whole.items()}
    stored_with(tmp_path / "bad.ckpt", made / "model.ckpt", filled)
    given = arguments(made)
    given[1] = str(tmp_path / "bad.ckpt")
    assert cli.run([*given, *(["--json"] if json_too else [])]) == 2
    told = capsys.readouterr()
    assert told.out == "" and words in told.err and told.err.count("\n") == 1


def test_a_page_without_plotly_is_refused_before_anything_is_written(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "plotly", None)
    monkeypatch.delitem(sys.modules, "datagen.train.prediction.page", raising=False)
    written = ("--html", str(tmp_path / "page.html"), "--out", str(tmp_path / "a.png"))
    refused(arguments(made, *written), capsys, "plotly: is not installed. Install the extra train: pip")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("z", [0.0, 1.0])
def test_a_cloud_of_equal_points(
    z: float, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It has an answer or an error, and no traceback: a point was drawn more than once into the sample."""
    n, target = 4000, "property uchar target\n"
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat ascii 1.0\nelement vertex {n}\n{axes}{target}end_header\n"
    (tmp_path / "equal.ply").write_text(head + f"0.5 0.2 {z} 1\n" * n)
    given = arguments(made, "--frame", str(tmp_path / "equal.ply"), "--gravity", "0,1,0")
    assert cli.run(given) in (0, 1, 2)
    assert "Traceback" not in capsys.readouterr().err

"""`datagen predict` as a user meets it: what it answers and writes."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch
from PIL import Image

import datagen
import datagen.workers.robots
from datagen import cli, released
from tests.datagen.predict.frames import arguments, frame_with
from tests.refusals import refused
from tests.sim_extra import needs_robots
from tests.small_disk import small_disk
from tests.small_runs import json_of
from tests.train.prediction.checkpoints import document_of, stored_with, write_untrained
from tests.train.prediction.seen_scenes import MODEL
from tests.train.prediction.test_trained_robots import SIZES, origin


def test_an_answer_as_json_picture_and_page(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, page = tmp_path / "a.png", tmp_path / "a.html"
    answer = json_of(capsys, arguments(made, "--out", str(out), "--html", str(page)))
    assert len(answer["candidates"]) == 51**2 and answer["best"]["state"] == "clear"
    scores = [c["score"] for c in answer["candidates"] if c["state"] == "clear"]
    assert answer["best"]["score"] >= max(scores) - 0.05
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
    assert text.count('" src="data:image/png;base64,') == 2  # the camera's image and the plan
    # The view draws symbols as text: a font without such a character as that of "x" shows a box.
    shapes = {"square", "square-open", "circle-open", "diamond-open"}
    assert set(re.findall(r'"symbol":"([\w-]+)"', text)) <= shapes
    assert "Plotly.newPlot" in text and "score 0." in text and 'src="http' not in text
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.html", "a.png"]


def test_the_drawing_of_the_sample_lists_what_it_shows(tmp_path: Path) -> None:
    frame, out = released.sample_frame(), tmp_path / "a.svg"
    sizes: dict[str, Any] = {"base_height": 0.7, "reach": 0.9}
    answer = datagen.predict(frame=[frame], map=[frame / released.MAP], out=out, **sizes)
    text = out.read_text()
    assert "<!-- occupied -->" in text and "<!-- target -->" in text
    x, y = answer.seen.eyes_m[0, :2] - answer.center_m[:2]
    assert max(abs(x), abs(y)) > 1.35 and "<!-- camera -->" not in text  # it stands outside
    assert len(text) < 1e6  # map and cloud are images: squares of a map had gaps between them


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
    }
    unmarked = frame_with(frame, tmp_path, mask=None)
    middle = np.argmin((v - np.nonzero(mask)[0].mean()) ** 2 + (u - np.nonzero(mask)[1].mean()) ** 2)
    answers["click"] = ["--frame", unmarked, "--click", f"{u[middle]},{v[middle]}"]
    rows, columns = np.nonzero(mask)
    box = columns.min() - 2, rows.min() - 2, columns.max() + 3, rows.max() + 3
    answers["box"] = ["--frame", unmarked, "--box", ",".join(map(str, box))]
    found = {name: json_of(capsys, ["predict", checkpoint, *given, *rest]) for name, given in answers.items()}
    whole, cloud = found["folder"], found.pop("ply")
    assert cloud["target"]["center_m"][2] == pytest.approx(whole["target"]["center_m"][2], abs=1e-5)
    for name, answer in found.items():
        gap = np.subtract(answer["target"]["center_m"], whole["target"]["center_m"])
        assert np.linalg.norm(gap) < (0.01 if name in ("click", "box") else 1e-5), name
    ours, theirs = ([c["score"] for c in a["candidates"]] for a in (found["npz"], whole))
    np.testing.assert_allclose(ours, theirs, atol=1e-4)
    assert np.ptp(theirs) > 0.1
    for name in ("click", "box"):
        assert found[name]["target"]["mask_pixels"] == pytest.approx(mask.sum(), rel=0.15), name


def test_a_frame_as_robots_and_data_sets_have_it(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same frame with TUM's folders and steps, and the camera in a file of ROS."""
    for source in ("color", "depth", "mask"):
        image = Image.open(made / "posed" / f"{source}.png")
        steps = np.asarray(image) * np.uint16(5) if source == "depth" else np.asarray(image)
        file = tmp_path / {"color": "rgb/1.2.png", "depth": "depth/1.3.png", "mask": "mask.png"}[source]
        file.parent.mkdir(exist_ok=True)
        Image.fromarray(steps).save(file)
    n = json.loads((made / "posed" / "intrinsics.json").read_text())
    K = [n["fx"], 0, n["ppx"], 0, n["fy"], n["ppy"], 0, 0, 1]
    (tmp_path / "camera_info.yaml").write_text(f"height: 240\nwidth: 320\nd: [0.0]\nk: {K}\n")
    (tmp_path / "pose.json").symlink_to(made / "posed" / "pose.json")
    drop = ("--camera-height",)
    usual = json_of(capsys, arguments(made, "--frame", str(made / "posed"), drop=drop))
    own = arguments(made, "--frame", str(tmp_path), "--depth-scale", "5000", drop=drop)
    found = json_of(capsys, own)
    np.testing.assert_allclose(found["target"]["center_m"], usual["target"]["center_m"], atol=1e-5)
    for key in ("x_m", "y_m", "score"):
        np.testing.assert_allclose(found["best"][key], usual["best"][key], atol=1e-3)
    for answer in (usual, found):  # millimetres as whole numbers, and a scale that is given
        assert not any("in steps of" in note for note in answer["notes"])
    refused([*own, "--out", str(tmp_path / "depth" / "1.3.png")], capsys, "is a file of the input")


def test_a_robots_file_gives_its_sizes_and_the_heading_of_its_side(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    panda = (Path(datagen.workers.robots.__file__).parent / "panda.toml").read_text()
    base = "footprint_m = [[0.3, 0.1], [-0.3, 0.1], [-0.3, -0.1], [0.3, -0.1]]\nheight_m = 0.65\n"
    side = 'presents = "side"\nside_deg = -90\n'
    answers = []
    document = document_of(made / "model.ckpt")
    record = origin(robots=SIZES, presents="side", side_deg=-90.0)
    trained = document["head"] | {"data": [record]}
    checkpoints = {"ahead": made / "model.ckpt", "right": tmp_path / "right.ckpt"}
    stored_with(checkpoints["right"], made / "model.ckpt", head=trained)
    for name, more in (("ahead", ""), ("right", side)):
        (tmp_path / f"{name}.toml").write_text(panda.replace("pedestal = true\n", base + more))
        robot = ("--robot", str(tmp_path / f"{name}.toml"))
        line = arguments(made, *robot, drop=("--base-height", "--reach"))
        (other,) = checkpoints.keys() - {name}
        words = ("--robot", "face the target", "have the target -90 deg from their front")
        refused([line[0], str(checkpoints[other]), *line[2:]], capsys, *words)
        answers.append(json_of(capsys, [line[0], str(checkpoints[name]), *line[2:]]))
    _, right = answers
    assert right["robot"]["base_height_m"] == 0.65 and right["robot"]["arm_reach_m"] == 0.947
    at = [{(round(c["x_m"], 4), round(c["y_m"], 4)): c for c in each["candidates"]} for each in answers]
    both = at[0].keys() & at[1].keys()  # one grid may be finer
    assert len(both) == 26**2
    turns = [at[1][xy]["yaw_rad"] - at[0][xy]["yaw_rad"] for xy in both]
    np.testing.assert_allclose(np.cos(np.array(turns) - np.pi / 2), 1.0)
    T, (x, y, _) = np.array(right["best"]["T_world_base"]), right["target"]["center_m"]
    at_right = np.linalg.inv(T) @ (x, y, 0.65, 1.0)
    assert at_right[1] < -0.1 and abs(at_right[0]) < 1e-6
    states = [[each[xy]["state"] for xy in both] for each in at]
    assert states[0] != states[1]  # the base is longer than wide
    again = arguments(made, *robot, "--base-height", "0.8", drop=("--reach",))
    own = json_of(capsys, [again[0], str(checkpoints["right"]), *again[2:]])
    assert own["robot"]["base_height_m"] == 0.8
    refused(arguments(made, "--robot", "hal"), capsys, "--robot", "hal", "panda")
    refused(arguments(made, "--robot", "panda-scaled", drop=("--reach",)), capsys, "--reach", "missing")


@needs_robots
def test_a_model_that_knows_kinematics_scores_the_named_robot(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_untrained(tmp_path / "model.ckpt", MODEL | {"kinematics": True})
    panda = (Path(datagen.workers.robots.__file__).parent / "panda.toml").read_text()
    base = "footprint_m = [[0.3, 0.1], [-0.3, 0.1], [-0.3, -0.1], [0.3, -0.1]]\nheight_m = 0.7\n"
    aside = panda.replace("pedestal = true\n", base + 'presents = "side"\nside_deg = 150\n')
    (tmp_path / "aside.toml").write_text(aside)

    def scores(*robot: str) -> list[float]:
        line = arguments(made, "--footprint", "0.3", *robot)
        answer = json_of(capsys, [line[0], str(tmp_path / "model.ckpt"), *line[2:]])
        return [each["score"] for each in answer["candidates"]]

    unnamed = scores()
    assert scores("--robot", "panda-scaled") == unnamed
    named = [scores("--robot", robot) for robot in ("panda", "ur5", "fetch", str(tmp_path / "aside.toml"))]
    assert all(np.abs(np.subtract(other, unnamed)).max() > 1e-6 for other in named)
    assert len({tuple(each) for each in named}) == len(named)


@pytest.mark.parametrize("base", ["2", "-2,-2;2,-2;2,2;-2,2"])
def test_a_frame_without_a_clear_place_ends_with_1(
    base: str, made: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(arguments(made, "--footprint", base)) == 1
    told = capsys.readouterr().out
    assert "none; no clear base pose was observed" in told and "0 clear" in told


def test_a_low_score_is_no_answer(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_untrained(tmp_path / "model.ckpt", MODEL, logit=-3.0)
    line = arguments(made)
    assert cli.run([line[0], str(tmp_path / "model.ckpt"), *line[2:], "--json"]) == 1
    answer = json.loads(capsys.readouterr().out)
    assert answer["best"] is None and answer["level"] == "none"
    assert re.fullmatch(r"the highest score of a clear base pose is only 0\.0\d\d", answer["reasons"][0])


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
    refused(arguments(made, *written), capsys, "plotly: is not installed. Install the extra page: pip")
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


def test_a_picture_that_a_full_disk_does_not_hold_is_named(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with small_disk(tmp_path / "disk", "64k") as disk:
        picture = disk / "answer.png"
        refused(arguments(made, "--out", str(picture)), capsys, f"{picture}: No space left on device")
        assert not list(disk.iterdir())

"""`datagen predict` from a recording to a goal, as a robot's user meets it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from datagen import cli
from tests.datagen.predict.frames import arguments, frame_with
from tests.refusals import refused
from tests.small_runs import json_of
from tests.train.prediction.checkpoints import write_untrained
from tests.train.prediction.recorded_scenes import record, write
from tests.train.prediction.seen_scenes import MODEL, Seen, draw_seen


@pytest.fixture(scope="module")
def scene() -> Seen:
    return draw_seen(0)


def clicked(made: Path) -> tuple[str, str]:
    """A pixel in the middle of the target."""
    v, u = np.nonzero(np.asarray(Image.open(made / "posed" / "mask.png")))
    at = int(np.argmin((v - v.mean()) ** 2 + (u - u.mean()) ** 2))
    return "--click", f"{u[at]},{v[at]}"


def scored(answer: dict[str, Any]) -> list[tuple[float, ...]]:
    return [(c["x_m"], c["y_m"], c["yaw_rad"], c["score"]) for c in answer["candidates"]]


def test_a_recording_gives_the_answer_of_its_frame(
    made: Path, scene: Seen, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_untrained(tmp_path / "model.ckpt", MODEL | {"hand_poses": 0})
    sent = record(scene)
    frame = frame_with(made / "posed", tmp_path, mask=None)
    line = arguments(made, *clicked(made), "--frame", frame, drop=("--camera-height",))
    line[1] = str(tmp_path / "model.ckpt")
    bag = write(tmp_path, [each for each in sent if each.topic != "/map"])
    from_bag = [*line[:-4], *clicked(made), "--bag", str(bag)]
    at = line.index("--frame")
    from_bag = [*line[:at], *line[at + 2 :], "--bag", str(bag)]
    alone, recorded = (json_of(capsys, each) for each in (line, from_bag))
    np.testing.assert_allclose(scored(recorded), scored(alone), atol=1e-4)
    assert [c["state"] for c in recorded["candidates"]] == [c["state"] for c in alone["candidates"]]
    np.testing.assert_allclose(recorded["T_world_camera"], alone["T_world_camera"], atol=1e-6)
    # The map of a recording shows floor that the camera does not see.
    (tmp_path / "mapped").mkdir()
    from_bag[-1] = str(write(tmp_path / "mapped", sent, sqlite=True, as_file=False))
    goal = tmp_path / "goal.yaml"
    answer = json_of(capsys, [*from_bag, "--goal", str(goal)])
    unseen = [sum(c["state"] == "unseen" for c in each["candidates"]) for each in (answer, recorded)]
    assert unseen[0] == 0 < unseen[1]
    found = yaml.safe_load(goal.read_text())
    best = np.array(answer["best"]["T_world_base"])
    position = found["goal"]["pose"]["position"]
    assert [position["x"], position["y"], position["z"]] == pytest.approx([*best[:2, 3], 0.0])
    assert found["reasons"] == answer["reason_codes"] and found["level"] == answer["level"] == "doubtful"
    assert found["goal"]["header"] == {
        "frame_id": "map",
        "stamp": {"sec": 1_700_000_001, "nanosec": 500_000_000},
    }
    assert cli.run([*from_bag, "--at", "0.5", "--at", "1.5"]) in (0, 1)


def test_the_frame_of_a_recording_is_written_to_click_in(
    made: Path, scene: Seen, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = str(write(tmp_path, [each for each in record(scene) if each.topic != "/map"]))
    folder, drop = tmp_path / "frame", ("--frame", "--camera-height")
    line = arguments(made, "--bag", bag, drop=drop)
    refused([*line, "--export", str(folder)], capsys, "target: is not marked")
    with Image.open(folder / "color.png") as picture:
        np.testing.assert_array_equal(np.asarray(picture), scene.frame.rgb)
    again = arguments(made, *clicked(made), "--frame", str(folder), drop=drop[1:])
    of_bag, of_folder = (json_of(capsys, each) for each in ([*line, *clicked(made)], again))
    assert scored(of_folder) == scored(of_bag)
    refused([*line, "--export", str(folder)], capsys, "exists already")


def test_no_goal_is_written_without_a_good_pose(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_untrained(tmp_path / "low.ckpt", MODEL, logit=-9.0)
    goal = tmp_path / "goal.yaml"
    goal.write_text("an older goal")
    line = arguments(made, "--frame", str(made / "posed"), "--goal", str(goal))
    line[1] = str(tmp_path / "low.ckpt")
    assert cli.run(line) == 1
    assert "none: " in capsys.readouterr().out and not goal.exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--goal", "{tmp}/goal.json"), ".yaml or .mcap or .pgm"),
        (("--goal", "{tmp}/map.yaml", "--map", "{tmp}/map.yaml"), "file of the input"),
        (("--goal", "{tmp}/map.pgm", "--keep-out", "{tmp}/map.yaml"), "file of the input"),
        (
            ("--out", "{tmp}/room.png", "--map", "{tmp}/map.yaml"),
            "file of the input",
        ),  # the map's own picture
        (("--depth-scale", "1000", "--bag", "{tmp}/a.mcap"), "given with --frame"),
        (("--bag", "{tmp}/a.mcap"), "given with --frame"),
        (("--at", "3"), "is for --bag"),
        (("--topic", "depth=/d"), "is for --bag"),
        (("--goal", "{tmp}/goal.yaml"), "needs frames with poses"),
    ],
)
def test_options_of_recordings_and_goals(
    options: tuple[str, ...], words: str, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Image.new("L", (9, 9), 254).save(tmp_path / "room.png")
    (tmp_path / "map.yaml").write_text("image: room.png\nresolution: 0.05\norigin: [0, 0, 0]\n")
    given = [each.format(tmp=tmp_path) for each in options]
    refused([*arguments(made), *given], capsys, words)


def test_gravity_is_refused_for_a_frame_with_a_pose(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = arguments(made, "--frame", str(made / "posed"), "--gravity", "0,1,0")
    refused(line, capsys, "--gravity: is given with the pose of")


@pytest.mark.parametrize("options", [("--bag", "{tmp}/a.mcap"), ("--goal", "{tmp}/goal.mcap")])
def test_the_extra_that_is_missing_is_named(
    options: tuple[str, ...], made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    for name in ("rosbags", "rosbags.rosbag2", "datagen.train.prediction.bags"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    for name in ("rosbags", "apsw"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, "datagen.train.prediction.recordings", raising=False)
    given = [each.format(tmp=tmp_path) for each in options]
    drop = ("--frame",) if options[0] == "--bag" else ()
    refused(
        [*arguments(made, drop=drop), *given], capsys, "rosbags: is not installed. Install the extra ros: pip"
    )

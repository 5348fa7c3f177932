"""Exports of executed trials to LeRobot: their layout, their videos, and its own reader."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from unittest import mock

import av
import numpy as np
import pandas
import pytest
from scipy.spatial.transform import Rotation

from datagen.exports.mp4 import Video
from datagen.schemas.errors import InputError
from datagen.schemas.fields import OUTCOMES
from tests.datagen.exports.conftest import export
from tests.refusals import refused
from tests.sim_extra import needs_sim
from tests.small_runs import arrays_of


@pytest.fixture(scope="module")
def lerobot(sim_run: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """An export of two scenes with few trials, and the rows of the run whose plans were executed in them."""
    out = export(sim_run, "lerobot", tmp_path_factory.mktemp("lerobot") / "out", "--scenes", "3:5")
    arrays = arrays_of(sim_run)
    executed = (arrays["attempts"] > 0) & np.isin(arrays["sample_scene_index"], (3, 4))
    return out, np.flatnonzero(executed)


@needs_sim
def test_lerobot_has_the_layout_of_its_version_3(lerobot: tuple[Path, np.ndarray], sim_run: Path) -> None:
    out, executed = lerobot
    arrays, info = arrays_of(sim_run), json.loads((out / "meta/info.json").read_text())
    episodes = pandas.read_parquet(out / "meta/episodes")
    frames = pandas.read_parquet(out / "data")
    assert info["codebase_version"] == "v3.0" and info["fps"] == 20 and info["robot_type"] == "panda-scaled"
    assert (info["total_episodes"], info["total_frames"]) == (len(episodes), len(frames))
    assert len(episodes) == len(executed) > 2
    assert episodes["label"].tolist() == arrays["label"][executed].tolist()
    assert (episodes["outcome"] == [tuple(OUTCOMES)[code] for code in arrays["outcome"][executed]]).all()
    assert frames["index"].tolist() == list(range(len(frames)))
    for episode in episodes.itertuples(index=False):
        rows = frames[episode.dataset_from_index : episode.dataset_to_index]
        assert len(rows) == episode.length and (rows["episode_index"] == episode.episode_index).all()
        np.testing.assert_allclose(rows["timestamp"], rows["frame_index"] / 20, atol=1e-6)
        state, action = np.stack(list(rows["observation.state"])), np.stack(list(rows["action"]))
        np.testing.assert_array_equal(action[:-1], state[1:])
        assert rows["next.success"].sum() == (episode.outcome == "success") == rows["next.success"].iloc[-1]
        height = np.stack(list(rows["observation.environment_state"]))[:, 2]
        assert (height[-1] > height[0] + 0.05) == (episode.outcome == "success")
    plain = {name: of for name, of in info["features"].items() if of["dtype"] != "video"}
    assert set(plain) == set(frames.columns)
    for name, feature in plain.items():
        column = frames[name]
        values = np.stack(list(column)) if column.dtype == object else column.to_numpy()[:, None]
        assert values.shape[1:] == tuple(feature["shape"]) and str(values.dtype) == feature["dtype"]
        stats = json.loads((out / "meta/stats.json").read_text())[name]
        wanted = [
            values.min(0),
            values.max(0),
            values.mean(0, np.float64),
            values.std(0, np.float64),
            [len(values)],
        ]
        for key, value in zip(("min", "max", "mean", "std", "count"), wanted, strict=True):
            np.testing.assert_allclose(stats[key], value, rtol=1e-5, atol=1e-6, err_msg=f"{name} {key}")
    tasks = pandas.read_parquet(out / "meta/tasks.parquet")
    assert episodes["tasks"].str[0].tolist() == [
        tasks.index[k] for k in episodes["tasks"].str[0].map(tasks["task_index"])
    ]
    assert (out / info["data_path"].format(chunk_index=0, file_index=0)).is_file()
    assert info["features"]["action"]["names"][-1] == "gripper_opening_m"


@needs_sim
def test_lerobot_has_pictures_of_each_frame(lerobot: tuple[Path, np.ndarray]) -> None:
    out, name = lerobot[0], "observation.images.exterior"
    info, table = json.loads((out / "meta/info.json").read_text()), pandas.read_parquet(out / "data")
    said, episodes = info["features"][name]["info"], pandas.read_parquet(out / "meta/episodes")
    for file, group in episodes.groupby(f"videos/{name}/file_index"):
        path = info["video_path"].format(video_key=name, chunk_index=0, file_index=file)
        with av.open(str(out / path)) as video:
            (stream,) = video.streams
            found = {"codec": stream.codec.canonical_name, "pix_fmt": stream.pix_fmt}
            found |= {"fps": stream.average_rate, "height": stream.height, "width": stream.width}
            assert {key: said[f"video.{key}"] for key in found} == found
            times, pictures = zip(
                *((f.time, f.to_ndarray(format="rgb24")) for f in video.decode()), strict=True
            )
        assert len(pictures) == group["length"].sum()
        for episode in group.to_dict("records"):
            ends = [episode[f"videos/{name}/{end}_timestamp"] for end in ("from", "to")]
            first, past = (round(end * info["fps"]) for end in ends)
            rows = table[episode["dataset_from_index"] : episode["dataset_to_index"]]
            # LeRobot finds a frame by its time, to 0.1 ms.
            np.testing.assert_allclose(np.array(times[first:past]) - ends[0], rows["timestamp"], atol=1e-4)
            shown = np.stack(pictures[first:past]).astype(np.int16)
            changed = (np.abs(np.diff(shown, axis=0)) > 40).any(3).sum((1, 2))
            joints = np.stack(list(rows["observation.state"]))[:, :-1]
            assert (changed[np.abs(np.diff(joints, axis=0)).max(1) > 0.03] > 10).all()
            assert (np.abs(shown[-1] - shown[0]) > 40).any(2).sum() > 300
            stats = {key: episode[f"stats/{name}/{key}"] for key in ("min", "max", "mean", "std", "count")}
            mean, std = (np.array([c[0][0] for c in stats[key]]) for key in ("mean", "std"))
            np.testing.assert_allclose(mean, shown.mean((0, 1, 2)) / 255, atol=0.02)
            np.testing.assert_allclose(std, shown.std((0, 1, 2)) / 255, atol=0.02)
            assert stats["count"] == [len(shown)]
            # The camera looks at the target.
            x, y, z, *quaternion = episode["camera_pose"]
            target = (
                Rotation.from_quat(quaternion)
                .inv()
                .apply(rows["observation.environment_state"].iloc[0][:3] - (x, y, z))
            )
            at_px = episode["camera_focal_px"] * target[:2] / target[2] + (160, 120)
            assert (at_px > 0).all() and (at_px < (320, 240)).all() and 0.5 < target[2] < 4
    stats = json.loads((out / "meta/stats.json").read_text())[name]
    assert np.shape(stats["mean"]) == np.shape(stats["min"]) == (3, 1, 1) and stats["count"] == [len(table)]
    means = np.array([[channel[0][0] for channel in mean] for mean in episodes[f"stats/{name}/mean"]])
    np.testing.assert_allclose(np.ravel(stats["mean"]), np.average(means, 0, episodes["length"]))


def test_lerobot_names_the_extra_of_a_missing_library(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for module in ("lerobot", "mp4"):
        monkeypatch.delitem(sys.modules, f"datagen.exports.{module}", raising=False)
    monkeypatch.setitem(sys.modules, "av", None)
    words = ["export", str(run), "--to", "lerobot", "--out", str(tmp_path / "out")]
    refused(words, capsys, "needs av, which is not installed", "Install the extra export")


def test_lerobot_names_the_extra_where_pyav_lacks_the_encoder(monkeypatch: pytest.MonkeyPatch) -> None:
    container = mock.Mock(add_stream=lambda *_, **__: av.Codec("no encoder", "w"))
    monkeypatch.setattr("av.open", lambda *_, **__: container)
    with pytest.raises(InputError, match=r"av: libx264: .* Install the extra export"):
        Video((320, 240), 20)


def test_a_videos_bytes_do_not_depend_on_what_memory_held() -> None:
    code = (
        "import sys; import numpy as np; from PIL import Image; from datagen.exports.mp4 import Video\n"
        "pixels = np.random.default_rng(0).integers(0, 256, (30, 40, 3), np.uint8)\n"
        "video, scene = Video((320, 240), 20), Image.fromarray(pixels).resize((640, 480))\n"
        "for k in range(12): video.add(scene.crop((9 * k, 5 * k, 9 * k + 320, 5 * k + 240)))\n"
        "sys.stdout.buffer.write(video.finished())"
    )
    # By glibc's malloc, which fills memory with a byte: 0xFE and 0x7F.
    first, again = (
        subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            check=True,
            env=os.environ | {"MALLOC_PERTURB_": held},
        ).stdout
        for held in ("1", "128")
    )
    assert first == again and len(first) > 10_000


@needs_sim
def test_lerobot_opens_with_its_own_reader(lerobot: tuple[Path, np.ndarray]) -> None:
    python = os.environ.get("DATAGEN_LEROBOT", sys.executable)
    code = (
        "import json, sys; from lerobot.datasets.lerobot_dataset import LeRobotDataset as D\n"
        "data = D('local/trials', root=sys.argv[1]); item = data[5]\n"
        "print(json.dumps([data.num_episodes, len(data), data.fps, item['action'].tolist(), item['task'],\n"
        "    list(item['observation.images.exterior'].shape)]))"
    )
    if python == sys.executable and not find_spec("lerobot"):
        pytest.skip(
            "lerobot pins other versions of torch and datasets; DATAGEN_LEROBOT names a python with it"
        )
    environment = os.environ | {"HF_HUB_OFFLINE": "1"}
    command = [python, "-c", code, str(lerobot[0])]
    told = subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout
    episodes, frames, fps, action, task, shape = json.loads(told.splitlines()[-1])
    table = pandas.read_parquet(lerobot[0] / "data")
    assert (episodes, frames, fps) == (len(lerobot[1]), len(table), 20)
    np.testing.assert_allclose(action, table["action"][5])
    assert task.startswith("Grasp the object ") and shape == [3, 240, 320]

"""Each export format, opened by the reader that people use for it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest import mock

import av
import datasets
import mlcroissant
import numpy as np
import pandas
import polars
import pyarrow.parquet as pq
import pytest
import trimesh
import webdataset
import yaml
from PIL import Image
from scipy.spatial.transform import Rotation

import datagen
from datagen import cli
from datagen.exports import FORMATS
from datagen.exports.mp4 import Video
from datagen.schemas.errors import InputError
from datagen.schemas.fields import OUTCOMES, RETRY_OUTCOMES
from datagen.schemas.run import Run
from datagen.schemas.shard_reading import read_scene
from datagen.train.prediction.frames import read_place
from datagen.workers.houses import split_of
from tests.conftest import once
from tests.refusals import refused
from tests.sim_extra import needs_sim
from tests.small_runs import CONFIG, PER_SCENE, arrays_of, make_small_run
from tests.train.conftest import sim_run

__all__ = ["sim_run"]

SCENES = 7
needs_rerun = pytest.mark.skipif(not find_spec("rerun"), reason="the extra `rerun` is not installed: 500 MB")


@pytest.fixture(scope="module")
def run(shared_folder: Path) -> Path:
    """Seven scenes, some in houses of validation; the last is cut to half of its candidates."""
    out = shared_folder / "exported"
    n = SCENES * PER_SCENE - PER_SCENE // 2
    return once(out, lambda: make_small_run(out, n, "--houses", "builtin:12"))


def export(run: Path, to: str, out: Path, *more: str) -> Path:
    assert cli.run(["export", str(run), "--to", to, "--out", str(out), *more]) == 0
    return out


def test_every_format_is_tested_here() -> None:
    tests = [name for name in globals() if name.startswith("test_")]
    assert all(any(name.startswith(f"test_{to}") for name in tests) for to in FORMATS)


def test_parquet_has_a_row_for_each_candidate_in_three_readers(run: Path, tmp_path: Path) -> None:
    folder = export(run, "parquet", tmp_path / "out") / "candidates"
    table, ours = pandas.read_parquet(folder), datagen.candidates(run)
    assert len(table) == len(ours) == arrays_of(run)["label"].size
    for name in set(ours.columns) - {"run", "cost_s"}:
        np.testing.assert_array_equal(table[name].isna(), ours[name].isna(), err_msg=name)
        np.testing.assert_array_equal(table[name].dropna(), ours[name].dropna().to_numpy(), err_msg=name)
    assert table["sample_id"].tolist() == datagen.candidates(run, columns=["sample_id"])["sample_id"].tolist()
    assert polars.read_parquet(folder)["label"].to_list() == table["label"].tolist()
    theirs = datasets.load_dataset(
        "parquet", data_files=str(folder / "*.parquet"), cache_dir=str(tmp_path / "cache"), split="train"
    )
    assert theirs["scene_id"] == table["scene_id"].tolist()
    schema = pq.read_schema(next(folder.iterdir()))
    about = schema.field("base_x_target_m").metadata
    assert (about[b"unit"], about[b"frame"]) == (b"m", b"target") and b"target's centre" in about[
        b"description"
    ]
    assert all(field.metadata[b"description"] for field in schema)
    assert json.loads(schema.metadata[b"datagen"])["license"].startswith("built-in houses: Apache-2.0")


@needs_sim
def test_parquet_has_the_outcomes_of_trials_as_texts(sim_run: Path, tmp_path: Path) -> None:
    table = pandas.read_parquet(export(sim_run, "parquet", tmp_path / "out") / "candidates")
    arrays = arrays_of(sim_run)
    assert table["outcome"].tolist() == [tuple(OUTCOMES)[code] for code in arrays["outcome"]]
    assert table["retry_outcome"].tolist() == [RETRY_OUTCOMES[code] for code in arrays["retry_outcome"]]
    assert set(table["robot"]) == {"panda-scaled"}


def test_huggingface_opens_the_folder_with_splits_and_features(run: Path, tmp_path: Path) -> None:
    out, cache = export(run, "huggingface", tmp_path / "out"), str(tmp_path / "cache")
    tables = {
        name: datasets.load_dataset(str(out), name, cache_dir=cache) for name in ("candidates", "scenes")
    }
    assert datasets.get_dataset_default_config_name(str(out)) == "candidates"
    arrays, names = arrays_of(run), {"train": "train", "val": "validation", "test": "test"}
    splits = [names[split_of(str(house))] for house in arrays["house_id"]]
    assert set(splits) == set(tables["scenes"]) > {"train"}  # otherwise another range of houses is needed
    for split, scenes in tables["scenes"].items():
        mine = [k for k, name in enumerate(splits) if name == split]
        assert scenes["scene_index"] == mine
        for k, points, mask in zip(mine, scenes["points_m"], scenes["target_mask"], strict=True):
            count = arrays["n_points"][k]
            np.testing.assert_array_equal(points, arrays["points_m"][k, :count].astype(np.float32))
            np.testing.assert_array_equal(mask, arrays["target_mask"][k, :count])
    read = tables["candidates"]
    assert sum(part.num_rows for part in read.values()) == arrays["label"].size
    card = yaml.safe_load((out / "README.md").read_text().split("---\n")[1])
    assert card["license"] == ["apache-2.0"] and card["size_categories"] == ["n<1K"]
    for about in card["dataset_info"]:  # the card's types are those of the files
        found = tables[about["config_name"]]["train"].features
        assert datasets.Features._from_yaml_list(about["features"]) == found  # pyright: ignore[reportPrivateUsage]
        sizes = {part["name"]: part["num_examples"] for part in about["splits"]}
        assert sizes == {name: part.num_rows for name, part in tables[about["config_name"]].items()}


def test_huggingface_has_a_croissant_description_without_a_complaint(run: Path, tmp_path: Path) -> None:
    out = export(run, "huggingface", tmp_path / "out")
    described = mlcroissant.Dataset(jsonld=str(out / "croissant.json"))
    assert not described.metadata.ctx.issues.errors and not described.metadata.ctx.issues.warnings
    rows = list(described.records("candidates-records"))
    labels = sorted(
        (row["candidates-records/sample_id"].decode(), row["candidates-records/label"]) for row in rows
    )
    ours = datagen.candidates(run, columns=["sample_id", "label"])
    assert labels == sorted(zip(ours["sample_id"], ours["label"], strict=True))


def test_webdataset_gives_clouds_and_labels(run: Path, tmp_path: Path) -> None:
    out = export(run, "webdataset", tmp_path / "out")
    samples = list(webdataset.WebDataset(str(out / "scenes-000000.tar"), shardshuffle=False).decode())
    opened, arrays = Run.open(run), arrays_of(run)
    assert len(samples) == SCENES
    for k, sample in enumerate(samples):
        rows = read_scene(opened, k)
        count = int(rows.record["n_points"])
        assert sample["__key__"] == f"{opened.manifest.spec_hash[:12]}-{k:06d}"
        np.testing.assert_array_equal(sample["cloud.npy"], rows.record["points_m"][:count].astype(np.float32))
        np.testing.assert_array_equal(sample["rgb.npy"], rows.record["rgb"][:count])
        np.testing.assert_array_equal(sample["target_mask.npy"], rows.record["target_mask"][:count])
        mine = arrays["sample_scene_index"] == k
        assert sample["json"]["candidates"]["label"] == arrays["label"][mine].tolist()
        assert sample["json"]["candidates"]["sample_id"][0] == arrays["sample_id"][mine][0].tobytes().hex()
        assert sample["json"]["object_name"] == [str(name) for name in rows.record["object_name"]]


def test_glb_has_the_house_the_objects_and_the_candidates(run: Path, tmp_path: Path) -> None:
    (file,) = export(run, "glb", tmp_path / "out", "--scenes", "6").glob("*.glb")
    scene, rows = trimesh.load_scene(file), read_scene(Run.open(run), 6)
    names = [str(name) for name in rows.record["object_name"]]
    for k, name in enumerate(names):
        T = scene.graph.get(f"object/{k}/{name}")[0]
        x, y, z, _ = rows.record["T_world_object"][k]
        np.testing.assert_allclose(T[:3], [x, z, -y], atol=1e-6)
    assert sum(name.startswith("house/") for name in scene.geometry) > 10
    corners = scene.geometry["candidates"].vertices.reshape(-1, 3, 3)  # the tip is ahead of the middle
    base_xy, yaw = (rows.samples[name][: PER_SCENE // 2] for name in ("base_xy_m", "base_yaw_rad"))
    np.testing.assert_allclose(corners.mean(axis=1)[:, :2], base_xy, atol=1e-5)
    ahead = (corners[:, 0] - corners.mean(axis=1))[:, :2] / 0.12
    np.testing.assert_allclose(ahead, np.stack([np.cos(yaw), np.sin(yaw)], axis=1), atol=1e-4)
    assert scene.metadata["license"].startswith("built-in houses")


@pytest.mark.parametrize("noisy", [False, True], ids=["exact", "noisy"])
def test_frames_have_the_stored_points_in_a_folder_that_predict_reads(
    noisy: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    noise = f"\n[observation.noise]\nenabled = {str(noisy).lower()}\n"
    config = CONFIG.replace("160", "320").replace("120", "240").replace("154", "308") + noise
    run = make_small_run(tmp_path / "run", 3 * PER_SCENE, config=config)
    out = export(run, "frames", tmp_path / "out", "--scenes", "1:3")
    lines = [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]
    assert [line["scene_index"] for line in lines] == [1, 2] and cli.run(["verify", str(out)]) == 0
    for line in lines:
        folder, record = out / line["frame"], read_scene(Run.open(run), line["scene_index"]).record
        _assert_stored_points(folder, line, record)
        capsys.readouterr()
        robot = ["--base-height", "0.7", "--reach", "0.9"]
        assert cli.run(["predict", "--frame", str(folder), *robot, "--json"]) in (0, 1)
        answer = json.loads(capsys.readouterr().out)
        np.testing.assert_allclose(
            answer["target"]["center_m"], record["target_center_m"], atol=0.06 if noisy else 0.04
        )


def _assert_stored_points(folder: Path, line: dict[str, Any], record: Mapping[str, Any]) -> None:
    """Each stored point is a pixel's, at its centre by K, and has its depth; masks and colours fit."""
    names = ("color", "depth", "mask", "objects")
    color, depth, mask, objects = (np.array(Image.open(folder / f"{name}.png")) for name in names)
    assert depth.dtype == np.uint16 and color.shape == (*depth.shape, 3) and color.std() > 10
    n, T, K = int(record["n_points"]), np.array(line["T_world_camera"]), np.array(line["K"])
    world = record["points_m"][:n].astype(np.float64) + record["target_center_m"]
    camera = (world - T[:3, 3]) @ T[:3, :3]
    u, v = (camera @ K.T)[:, :2].T / camera[:, 2]
    column, row = np.rint([u, v]).astype(int)
    assert max(np.abs(u - column).max(), np.abs(v - row).max()) < 0.3
    # Half a millimetre of depth.png, and as much of float16 up to 1 m from the target.
    assert np.abs(depth[row, column] / 1000 - camera[:, 2]).max() < 1e-3
    assert (mask[row, column] == 255 * record["target_mask"][:n]).all()
    assert ((objects == 1) == (mask == 255)).all() and line["object_name"][0] == record["object_name"][0]
    read = read_place(folder)
    assert read.image is not None and read.T_world_camera is not None
    np.testing.assert_allclose(read.T_world_camera, record["T_world_camera"], atol=1e-12)
    back = read.image.points(row * depth.shape[1] + column) @ T[:3, :3].T + T[:3, 3]
    assert np.linalg.norm(back - world, axis=1).max() < 2e-3


def test_frames_of_real_houses_show_each_object_and_light_changes_no_depth(
    assets: Path, real_objects: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    real = ("--houses", f"procthor:{assets / 'procthor'}", "--objects", real_objects)
    config = "[scene]\nplaces = {shelf = 1, inside = 1}\n"
    run = make_small_run(tmp_path / "run", 2 * PER_SCENE, *real, config=CONFIG + config)
    lines = (export(run, "frames", tmp_path / "out") / "frames.jsonl").read_text().splitlines()
    for line in map(json.loads, lines):
        folder, record = (
            tmp_path / "out" / line["frame"],
            read_scene(Run.open(run), line["scene_index"]).record,
        )
        assert line["place"] in ("shelf", "inside") and line["split"] == split_of(str(record["house_id"]))
        _assert_stored_points(folder, line, record)
    gone = ["export", str(run), "--to", "frames", "--out", str(tmp_path / "new"), "--houses", "procthor:gone"]
    refused(gone, capsys, "gone", "no such folder of houses")


def entities(file: Path) -> dict[str, list[Any]]:
    """The chunks of a recording by entity, as Arrow batches."""
    from rerun.chunk import RrdReader

    found: dict[str, list[Any]] = {}
    for chunk in RrdReader(str(file)).stream():
        batch = chunk.to_record_batch()
        found.setdefault(batch.schema.metadata[b"rerun:entity_path"].decode(), []).append(batch)
    return found


@needs_rerun
@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_rerun_has_the_cloud_and_the_candidates(run: Path, tmp_path: Path) -> None:
    (file,) = export(run, "rerun", tmp_path / "out", "--scenes", "2").glob("*.rrd")
    found, rows = entities(file), read_scene(Run.open(run), 2)
    assert {"/", "/house", "/objects/0", "/camera", "/headings"} <= set(found)
    (cloud,), (bases,) = found["/cloud"], found["/candidates"]
    points = np.array(cloud["Points3D:positions"][0].as_py())
    wanted = rows.record["points_m"][: int(rows.record["n_points"])] + rows.record["target_center_m"]
    np.testing.assert_allclose(points, wanted, atol=1e-3)
    xy = np.array(bases["Points3D:positions"][0].as_py())[:, :2]
    np.testing.assert_allclose(xy, rows.samples["base_xy_m"], atol=1e-5)
    pose, pinhole = sorted(found["/camera"], key=lambda batch: "Pinhole:resolution" in batch.schema.names)
    T, (fx, _, cx, cy) = rows.record["T_world_camera"], rows.record["intrinsics_px"]
    columns = pose["Transform3D:mat3x3"][0].as_py()[0]  # Rerun stores matrices by columns
    np.testing.assert_allclose(columns, T[:3, :3].T.ravel(), atol=1e-6)
    np.testing.assert_allclose(pose["Transform3D:translation"][0].as_py()[0], T[:3, 3], atol=1e-6)
    intrinsics = pinhole["Pinhole:image_from_camera"][0].as_py()[0]
    np.testing.assert_allclose(np.array(intrinsics)[[0, 6, 7]], [fx, cx, cy], atol=1e-4)


@needs_rerun
@needs_sim
@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_rerun_has_the_best_trial_over_time(sim_run: Path, tmp_path: Path) -> None:
    arrays = arrays_of(sim_run)
    scene = int(arrays["sample_scene_index"][arrays["outcome"] == 0][0])
    (file,) = export(sim_run, "rerun", tmp_path / "out", "--scenes", str(scene)).glob("*.rrd")
    found = entities(file)
    (moving,) = (batch for batch in found["/objects/0"] if "Transform3D:translation" in batch.schema.names)
    assert "trial" in moving.schema.names  # a static pose beside it would hide it
    heights = [row[0][2] for row in moving["Transform3D:translation"].to_pylist()]
    assert heights[-1] > heights[0] + 0.05  # lifted
    assert found["/joints"][0].num_rows == len(heights) > 20 and "/robot/0" in found


@pytest.fixture(scope="module")
def lerobot(sim_run: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """An export of the first two scenes, and the rows of the run whose plans were executed in them."""
    out = export(sim_run, "lerobot", tmp_path_factory.mktemp("lerobot") / "out", "--scenes", "0:2")
    arrays = arrays_of(sim_run)
    executed = (arrays["attempts"] > 0) & (arrays["sample_scene_index"] < 2)
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

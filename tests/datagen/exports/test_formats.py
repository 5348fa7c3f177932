"""Each export format, opened by the reader that people use for it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

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

import datagen
from datagen import cli
from datagen.exports import FORMATS
from datagen.schemas.fields import OUTCOMES, RETRY_OUTCOMES
from datagen.schemas.run import Run
from datagen.schemas.shard_reading import read_scene
from datagen.train.prediction.frames import read_place
from datagen.workers.houses import split_of
from tests.datagen.exports.conftest import SCENES, export
from tests.refusals import refused
from tests.sim_extra import needs_sim
from tests.small_runs import CONFIG, PER_SCENE, arrays_of, make_small_run

needs_rerun = pytest.mark.skipif(not find_spec("rerun"), reason="the extra `rerun` is not installed: 500 MB")


def test_every_format_is_tested_here() -> None:
    tests = "".join(file.read_text() for file in Path(__file__).parent.glob("test_*.py"))
    assert all(f"\ndef test_{to}_" in tests for to in FORMATS)


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
    assert "frames: about 64.5 kB, 0.2 s of a core; fewer --scenes cost less\n" in capsys.readouterr().err
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
    view = tmp_path / "view"
    again = ["--scenes-from", str(run), "--view", "1", "--n", str(3 * PER_SCENE), "--workers", "0"]
    assert cli.run(["submit", "heuristic", *again, "--out", str(view)]) == 0
    out = export(view, "frames", tmp_path / "seen")
    for line in map(json.loads, (out / "frames.jsonl").read_text().splitlines()):
        record = read_scene(Run.open(view), line["scene_index"]).record
        _assert_stored_points(out / line["frame"], line, record)


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
    some_real_houses: str, real_objects: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    real = ("--houses", some_real_houses, "--objects", real_objects)
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
    (names,), curves = (batch.to_pylist() for batch in sorted(found["/joints"], key=len))
    assert len(curves) == len(heights) > 20 and "/robot/0" in found
    assert names["SeriesLines:names"][0] == "panda_joint1"

"""A run of the schema before headings: read, shown, extended, labelled again and checked as it was made."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

import datagen
from datagen import cli
from datagen.configuration import specify
from datagen.schemas.fields import SCHEMAS
from datagen.schemas.run import Run
from datagen.schemas.shard_reading import read_scene
from datagen.workers.rendering import RENDERERS
from tests.columns import columns_of
from tests.refusals import refused
from tests.small_runs import CONFIG, HERE, PER_SCENE, arrays_of, assert_equal_runs, make_small_run

YAW = "base_yaw_rad"


@pytest.fixture(scope="module")
def older(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sealed run of version 4. Tests only read it."""
    with pytest.MonkeyPatch.context() as patch:
        known = {name: schema.of_version(4) for name, schema in SCHEMAS.items()}
        patch.setattr(specify, "SCHEMAS", known)
        run = make_small_run(tmp_path_factory.mktemp("older") / "run", 3 * PER_SCENE)
    assert Run.open(run).manifest.schema_version == 4 and YAW not in arrays_of(run)
    return run


@pytest.fixture
def copied(older: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(older, tmp_path / "run"))


def facing(arrays: dict[str, np.ndarray]) -> np.ndarray:
    towards = np.repeat(arrays["target_center_m"][:, :2], PER_SCENE, axis=0) - arrays["base_xy_m"]
    return np.arctan2(towards[:, 1], towards[:, 0])


def test_every_reader_gives_headings_that_face_the_target(older: Path) -> None:
    arrays = arrays_of(older)
    wanted = facing(arrays)
    for place in (older, older / "data.zarr"):
        table = datagen.candidates(place)
        np.testing.assert_allclose(table["base_yaw_world_rad"], wanted, atol=1e-6)
        np.testing.assert_allclose(datagen.candidates(place, columns=[YAW])[YAW], wanted, atol=1e-6)
        read = [shard[YAW] for shard in columns_of(place, [YAW])]
        np.testing.assert_allclose(np.concatenate(read), wanted, atol=1e-6)
        dataset = datagen.open_dataset(place)
        assert dataset[YAW].attrs["units"] == "rad" and dataset[YAW].dtype == np.float32
        np.testing.assert_allclose(dataset[YAW][5:11], wanted[5:11], atol=1e-6)
        batches = list(datagen.stream(str(place), extra=[YAW], shuffle=False).epoch(0))
        found = {bytes(i): y for b in batches for i, y in zip(b.sample_id, b.extra[YAW], strict=True)}
        for name, yaw in zip(arrays["sample_id"], wanted, strict=True):
            assert found[name.tobytes()] == pytest.approx(yaw, abs=1e-6)
    assert read_scene(Run.open(older), 1).samples[YAW] == pytest.approx(wanted[PER_SCENE : 2 * PER_SCENE])


def test_it_is_checked_shown_and_extended_as_it_was_made(
    older: Path, copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(["verify", str(copied), "--replay", "2"]) == 0
    assert cli.run(["show", str(copied), "--scene", "1", "--out", str(tmp_path / "a.png")]) == 0
    assert cli.run(["resume", str(copied), "--n", str(4 * PER_SCENE), *HERE]) == 0
    longer = arrays_of(copied)
    assert YAW not in longer and len(longer["label"]) == 4 * PER_SCENE
    for name, values in arrays_of(older).items():
        np.testing.assert_array_equal(longer[name][: len(values)], values, err_msg=name)
    assert cli.run(["verify", str(copied), "--replay", "4"]) == 0
    new = make_small_run(tmp_path / "new", 4 * PER_SCENE)
    since = {f.name for _, f in SCHEMAS["heuristic"].fields if f.since > 4}
    assert_equal_runs({name: a for name, a in arrays_of(new).items() if name not in since}, longer)
    refused(["merge", str(copied), str(new), "--out", str(tmp_path / "both")], capsys, "schema_version")


def test_its_scenes_are_labelled_again(older: Path, tmp_path: Path) -> None:
    again, ruled = tmp_path / "again", tmp_path / "ruled"
    line = ["submit", "heuristic", "--n", str(3 * PER_SCENE), "--scenes-from", str(older)]
    assert cli.run([*line, "--out", str(again), *HERE]) == 0
    made, before = arrays_of(again), arrays_of(older)
    np.testing.assert_array_equal(made[YAW], facing(before).astype(np.float32))
    np.testing.assert_array_equal(made["label"], before["label"])
    assert cli.run(["relabel", str(older), "--out", str(ruled), "--tau", "0.5"]) == 0
    for run in (again, ruled):
        assert cli.run(["verify", str(run), "--replay", "1"]) == 0


def test_a_run_of_a_renderer_that_is_gone_is_read_but_neither_resumed_nor_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("sapien", reason="SAPIEN cannot be imported here", exc_type=ImportError)
    run, config = tmp_path / "run", CONFIG.replace("[observation]\n", "[observation]\nrenderer = 'sapien'\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(RENDERERS, "sapien", RENDERERS["embree"])
        make_small_run(run, PER_SCENE, config=config)
    gone = ("observation.renderer: sapien: is unknown", "embree")
    refused(["resume", str(run), "--n", str(2 * PER_SCENE), *HERE], capsys, *gone)
    refused(["show", str(run), "--scene", "0", "--out", str(tmp_path / "scene.png")], capsys, *gone)
    for verb in ("status", "audit", "verify"):
        assert cli.run([verb, str(run)]) == 0
    again = tmp_path / "again"
    assert cli.run(["relabel", str(run), "--out", str(again), "--tau", "0.5"]) == 0

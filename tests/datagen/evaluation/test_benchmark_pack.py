"""Packs of a benchmark: the runs' first scenes, scored as in the runs, refused where they differ."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from zarr.storage import ZipStore

from datagen.evaluation import benchmark
from datagen.evaluation.columns import gather
from datagen.evaluation.runs import open_evaluated_runs
from datagen.train.baselines import make_baselines
from scripts import pack_benchmark
from tests.conftest import REPOSITORY
from tests.datagen.evaluation.conftest import SIDE
from tests.linked_environments import install_wheel, link_libraries, wheel
from tests.made_runs import files_of, flip
from tests.refusals import refused
from tests.sim_extra import needs_sim
from tests.small_runs import arrays_of, json_of

pytestmark = needs_sim
__all__ = ["wheel"]
SCENES = 5  # of two runs: 3 of `test` with 4 candidates, 2 whole grids
RUNS = ("test", "grids")


def packed(runs: Path, out: Path, *more: str) -> Path:
    assert pack_benchmark.main([str(runs), str(out), "--scenes", str(SCENES), *more]) == 0
    return out


@pytest.fixture(scope="module")
def pack(small_benchmark: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pack of the small benchmark. Tests only read it."""
    return packed(small_benchmark, tmp_path_factory.mktemp("packed") / "pack")


def stored(pack: Path, name: str) -> dict[str, np.ndarray[Any, Any]]:
    """Every array of a packed run, read by zarr alone."""
    with ZipStore(pack / f"{name}.zarr.zip", mode="r") as store:
        return {key: np.asarray(array[...]) for key, array in zarr.open_group(store, mode="r").arrays()}


def test_a_pack_has_the_first_scenes_and_the_same_bytes_each_time(
    small_benchmark: Path, pack: Path, tmp_path: Path
) -> None:
    assert files_of(pack) == files_of(packed(small_benchmark, tmp_path / "again"))
    assert sorted(files_of(pack)) == ["benchmark.json", "grids.zarr.zip", "test.zarr.zip"]
    assert str(small_benchmark).encode() not in b"".join(files_of(pack).values())
    for name, scenes, samples in (("test", 3, 12), ("grids", 2, 2 * SIDE * SIDE)):
        ours, theirs = stored(pack, name), arrays_of(small_benchmark / name)
        rows = {"scene": scenes, "sample": samples}
        assert len(ours["points_m"]) == scenes and len(ours["label"]) == samples
        for key, values in ours.items():
            table = "scene" if len(theirs[key]) == len(theirs["scene_index"]) else "sample"
            np.testing.assert_array_equal(values, theirs[key][: rows[table]], err_msg=key)
            assert values.dtype == theirs[key].dtype


def test_a_pack_of_a_pack_is_its_first_scenes(pack: Path, tmp_path: Path) -> None:
    again = packed(pack, tmp_path / "again")
    for name in RUNS:
        assert (again / f"{name}.zarr.zip").read_bytes() == (pack / f"{name}.zarr.zip").read_bytes()


def test_scores_on_a_pack_are_those_of_its_scenes_in_the_runs(
    small_benchmark: Path, pack: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scorers = {
        baseline.name: baseline for baseline in make_baselines(["proximity", "reach-share", "analytic"])
    }

    def columns_of(paths: list[str]) -> Any:
        runs = open_evaluated_runs(paths)
        return gather([(run.cells, run.batches()) for run in runs], scorers)[0]

    ours = columns_of([str(pack / f"{name}.zarr.zip") for name in RUNS])
    full = columns_of([str(small_benchmark / name) for name in RUNS])
    first = [np.flatnonzero(full.run == k)[:scenes] for k, scenes in enumerate((3, 2))]
    theirs = full.of_scenes(np.isin(np.arange(full.n_scenes), np.concatenate(first)))
    for name in ("scene", "label", "is_clear", "base_xy_m", "is_grid", "house"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=name)
    for name, score in theirs.scores.items():
        np.testing.assert_array_equal(ours.scores[name], score, err_msg=name)
    report = json_of(capsys, ["benchmark", "score", *scorers, "--runs", str(pack)])
    assert report["benchmark"]["version"] == "small pack of 5 scenes"
    label, score = theirs.label, theirs.scores["proximity"]
    sides = theirs.scene < 3
    told = report["parts"][0]["sets"]["in-range"]["methods"]["proximity"]
    higher = score[sides & label][:, None] - score[sides & ~label]
    assert told["area_under_roc"]["value"] == pytest.approx(((higher > 0) + (higher == 0) / 2).mean())


def test_runs_and_packs_of_draws_are_judged_by_their_successes(small_benchmark: Path, pack: Path) -> None:
    for folder in (str(small_benchmark / "grids"), str(pack / "grids.zarr.zip")):
        (run,) = open_evaluated_runs([folder])
        rows = [(batch.label, batch.extra["successes"]) for batch in run.batches()]
        label, successes = (np.concatenate(each) for each in zip(*rows, strict=True))
        np.testing.assert_array_equal(label, successes >= 2)
        assert label.any() or folder.endswith(".zip")  # the pack has the first scenes alone


def test_without_runs_the_pack_of_the_package_is_scored(
    pack: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(benchmark, "PACK", tmp_path)
    refused(["benchmark", "score", "proximity"], capsys, "this version comes without a pack")
    monkeypatch.setattr(benchmark, "PACK", pack)
    assert json_of(capsys, ["benchmark", "score", "proximity"])["benchmark"]["not_scored"] == []


def code_of_the_documents() -> str:
    """The Python code that reads the package's pack and writes my_scores.csv."""
    page = (REPOSITORY / "docs" / "results" / "benchmark.md").read_text()
    (code,) = [part.split("```")[0] for part in page.split("```python\n")[1:] if "ZipStore" in part]
    return code


def test_the_code_of_the_documents_scores_a_pack(
    pack: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    own = 'Path(datagen.__file__).parent / "evaluation" / "pack"'
    code = code_of_the_documents()
    assert code.count(own) == 1 and Path(benchmark.__file__).with_name("pack") == benchmark.PACK
    command = [sys.executable, "-c", code.replace(own, f"Path({str(pack)!r})")]
    subprocess.run(command, cwd=tmp_path, check=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(benchmark, "PACK", pack)
    report = json_of(capsys, ["benchmark", "score", "my_scores.csv"])
    told = report["parts"][0]["sets"]["in-range"]["methods"]["my_scores"]
    assert told["area_under_roc"]["value"] > 0


@pytest.mark.slow
def test_the_extra_predict_is_enough_in_an_empty_folder(wheel: Path, pack: Path, tmp_path: Path) -> None:
    site = install_wheel(wheel, tmp_path / "venv")
    link_libraries(site, "predict")
    shutil.rmtree(site / "datagen" / "evaluation" / "pack", ignore_errors=True)
    shutil.copytree(pack, site / "datagen" / "evaluation" / "pack")
    (tmp_path / "empty").mkdir()

    def done(program: str, *words: str) -> subprocess.CompletedProcess[str]:
        command = [tmp_path / "venv" / "bin" / program, *words]
        environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "DATAGEN"))}
        return subprocess.run(
            command, cwd=tmp_path / "empty", env=environment, capture_output=True, text=True, check=False
        )

    assert done("python", "-c", "import torch").returncode != 0
    assert done("python", "-c", code_of_the_documents()).returncode == 0
    rules = ("proximity", "reach-share", "threshold", "analytic")
    scored = done("datagen", "benchmark", "score", *rules, "my_scores.csv", "--out", "board.json")
    assert scored.returncode == 0, scored.stderr
    assert "my_scores" in (tmp_path / "empty" / "board.json").read_text()
    released = done("datagen", "benchmark", "score", "released", "--json")
    assert released.returncode == 0, released.stderr
    (method,) = json.loads(released.stdout)["methods"]
    assert method["name"] == "released" and method["checkpoint"]["data"]


def copied(pack: Path, folder: Path) -> Path:
    folder.mkdir()
    for name, data in files_of(pack).items():
        (folder / name).write_bytes(data)
    return folder


@pytest.mark.parametrize("damage", ["flip", "cut", "array"])
def test_a_damaged_file_is_named_in_one_line(
    damage: str, pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = copied(pack, tmp_path / "damaged") / "grids.zarr.zip"
    data = file.read_bytes()
    if damage == "flip":
        flip(file)
    elif damage == "cut":
        file.write_bytes(data[: len(data) // 2])
    else:
        file.write_bytes(data.replace(b"points_m/c.", b"points_m/x."))
    assert file.read_bytes() != data
    refused(["benchmark", "score", "proximity", "--runs", str(file.parent)], capsys, str(file))


def test_a_definition_that_does_not_fit_is_refused(
    small_benchmark: Path, pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = copied(pack, tmp_path / "other")
    definition = folder / "benchmark.json"
    words = ["benchmark", "score", "proximity", "--runs", str(folder)]
    definition.write_bytes((small_benchmark / "benchmark.json").read_bytes())
    refused(words, capsys, "test.zarr.zip: labels: are 12, but 32 in run test of benchmark small")
    changed = json.loads((pack / "benchmark.json").read_text())
    changed["runs"]["grids"]["digests"]["labels"] = "0" * 64
    definition.write_text(json.dumps(changed))
    refused(words, capsys, "grids.zarr.zip: labels: have the digest")


def test_a_pack_without_labels_is_read_but_not_scored(
    small_benchmark: Path, pack: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    blind = packed(small_benchmark, tmp_path / "blind", "--without-labels")
    assert (blind / "benchmark.json").read_bytes() == (pack / "benchmark.json").read_bytes()
    for name in RUNS:
        hidden = {"label", "successes"} if name == "grids" else {"label"}
        assert stored(pack, name).keys() - stored(blind, name).keys() == hidden
    told = "test.zarr.zip: label: is not a field of the run"
    refused(["benchmark", "score", "proximity", "--runs", str(blind)], capsys, told)


def test_a_pack_is_not_written_over_files_or_without_a_scene_a_run(
    small_benchmark: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for out, more, told in (
        (small_benchmark, (), "--out: is not empty"),
        (tmp_path / "new", ("--scenes", "1"), "--scenes: 1: is less than the 2 runs"),
    ):
        assert pack_benchmark.main([str(small_benchmark), str(out), *more]) == 2
        assert told in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_the_shipped_pack_is_of_the_shipped_benchmark_and_names_its_sources() -> None:
    pack = benchmark.PACK
    told, shipped = benchmark.read_benchmark(pack), benchmark.read_benchmark()
    assert told.version == f"{shipped.version} pack of 98 scenes"
    assert {name: run.spec for name, run in told.runs.items()} == {n: r.spec for n, r in shipped.runs.items()}
    assert sum(path.stat().st_size for path in pack.iterdir()) < 4_000_000
    text = (pack / "ATTRIBUTION.md").read_text("utf-8")
    assert all(word in text for word in ("ProcTHOR", "Apache License 2.0", "YCB", "Attribution 4.0"))

"""`datagen benchmark score` on small planned runs, held against numbers that are computed here."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen import cli
from datagen.evaluation.report import parts_by_place
from datagen.evaluation.report_tables import grid_tables
from tests.datagen.evaluation.conftest import checkpoint
from tests.datagen.evaluation.made_columns import make_columns
from tests.refusals import refused
from tests.sim_extra import needs_sim
from tests.small_runs import arrays_of, json_of

pytestmark = needs_sim


def scores_of(capsys: pytest.CaptureFixture[str], runs: Path, *words: str) -> dict[str, Any]:
    return json_of(capsys, ["benchmark", "score", *words, "--runs", str(runs)])


def not_scored(capsys: pytest.CaptureFixture[str], runs: Path | str, method: str, told: str) -> None:
    refused(["benchmark", "score", method, "--runs", str(runs)], capsys, told)


def test_trainings_that_differ_by_their_seed_have_a_mean(
    small_benchmark: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seeds = [
        checkpoint(tmp_path / f"seed{k}.ckpt", options={"seed": k, "lr": 0.1}, cost={"train_cpu_s": k})
        for k in (1, 2)
    ]
    other = checkpoint(tmp_path / "other.ckpt", options={"seed": 3, "lr": 0.2})
    report = scores_of(capsys, small_benchmark, *seeds, other, "proximity")
    for table in (report["parts"][0]["sets"]["in-range"], report["parts"][1]["grids"]):
        assert [m["of"] for m in table["means"]] == [["seed1", "seed2"]]
    assert cli.run(["benchmark", "score", *seeds, "--runs", str(small_benchmark), "--full"]) == 0
    told = capsys.readouterr().out
    assert told.count("mean of 2 like seed1") >= 2
    assert "their intervals hold seeds too" in told


def test_a_terminal_gets_the_picks_of_every_method_in_few_lines(
    small_benchmark: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rules = ("proximity", "reach-share", "threshold", "analytic")
    report = scores_of(capsys, small_benchmark, *rules)
    words = ["benchmark", "score", *rules, "--runs", str(small_benchmark)]
    assert cli.run(words) == 0
    short = capsys.readouterr().out.splitlines()
    assert cli.run([*words, "--full"]) == 0
    assert len(short) <= 25 and len(capsys.readouterr().out.splitlines()) > 2 * len(short)
    heads, row = short[1].split(), next(line for line in short if line.startswith("grids ("))
    assert sorted(heads[1:]) == sorted(rules)
    (grids,) = (part["grids"] for part in report["parts"] if part["title"] == "grids")
    assert f"({grids['scenes'] - grids['scenes_without_positive']})" in row
    picks = [f"{100 * grids['methods'][name]['good']['value']:.0f} [" for name in heads[1:]]
    assert all(pick in row for pick in picks)


def test_checkpoints_files_and_baselines_are_scored(
    small_benchmark: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, out = checkpoint(tmp_path / "tiny.ckpt"), tmp_path / "board.json"
    write_near(small_benchmark, tmp_path / "file.csv", "test", "grids")
    report = scores_of(
        capsys, small_benchmark, model, str(tmp_path / "file.csv"), "proximity", "--out", str(out)
    )
    assert json.loads(out.read_text()) == report
    assert [m["name"] for m in report["methods"]] == ["tiny", "file", "proximity"]
    # Reading a file is not the time of its method.
    assert [m["seconds_per_600"] is None for m in report["methods"]] == [False, True, False]
    table = next(grid_tables(report, next(part["grids"] for part in report["parts"] if part["grids"])))
    assert {row[0]: row[-1] == "-" for row in table.rows[:3]} == {
        "tiny": False,
        "file": True,
        "proximity": False,
    }
    assert str(tmp_path) not in out.read_text() and str(small_benchmark) not in out.read_text()
    stored = arrays_of(small_benchmark / "test")
    label, score = stored["label"] == 1, near(stored)
    told = report["parts"][0]["sets"]["in-range"]["methods"]["file"]
    sides = [((score >= 0.5) == label)[label == side].mean() for side in (True, False)]
    assert told["balanced_accuracy"]["value"] == pytest.approx(np.mean(sides))
    assert report["benchmark"]["version"] == "small" and report["benchmark"]["not_scored"] == []


def near(stored: dict[str, np.ndarray]) -> np.ndarray:
    """Scores that fall with the distance."""
    return 1 / (1 + stored["distance_m"].astype(np.float64) / stored["arm_reach_m"])


def write_near(runs: Path, out: Path, *names: str) -> None:
    """The scores of `near` for the clear candidates of these runs."""
    lines = ["sample_id,score"]
    for name in names:
        stored = arrays_of(runs / name)
        score = near(stored)
        rows = np.flatnonzero(stored["base_is_clear"])
        lines += [f"{stored['sample_id'][row].tobytes().hex()},{score[row]:.6f}" for row in rows]
    out.write_text("\n".join(lines) + "\n")


def test_whole_grids_and_decisive_ones_are_parts_of_their_own(
    small_benchmark: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("grids", "benchmark.json"):
        (tmp_path / name).symlink_to(small_benchmark / name)
    report = scores_of(capsys, tmp_path, "proximity")
    stored = arrays_of(small_benchmark / "grids")
    scenes = stored["sample_scene_index"]
    clear, good = stored["base_is_clear"], stored["label"] == 1
    near = clear & (stored["mount_distance_m"] <= stored["arm_reach_m"])
    mixed = [s for s in np.unique(scenes) if 0 < good[clear & (scenes == s)].mean() < 1]
    shares = [good[near & (scenes == s)].mean() for s in mixed]
    expected = {"grids": len(np.unique(scenes)), "grids, decisive": sum(0.05 <= s <= 0.6 for s in shares)}
    parts = {part["title"]: part["grids"] for part in report["parts"]}
    assert {title: grids["scenes"] for title, grids in parts.items()} == {
        title: n for title, n in expected.items() if n
    }
    arrivals = parts["grids"]["arrivals"]
    assert len(arrivals) == 6 and set(arrivals[0]["methods"]["proximity"]) == {"nominal", "smoothed"}
    assert arrivals[0]["best"] == 1.0 >= arrivals[-1]["best"]
    assert report["benchmark"]["not_scored"] == ["test"]
    assert cli.run(["benchmark", "score", "proximity", "--runs", str(tmp_path)]) == 0
    assert "not scored" in capsys.readouterr().out


def changed_runs(small_benchmark: Path, folder: Path, path: tuple[str, ...], value: Any) -> str:
    """A folder with the runs, and with another definition of the run `test`."""
    definition = json.loads((small_benchmark / "benchmark.json").read_text())
    section = definition["runs"]["test"]
    for key in path[:-1]:
        section = section[key]
    section[path[-1]] = value
    folder.mkdir()
    (folder / "benchmark.json").write_text(json.dumps(definition))
    for name in ("test", "grids"):
        (folder / name).symlink_to(small_benchmark / name)
    return str(folder)


@pytest.mark.parametrize(
    ("path", "value", "told"),
    [
        (("spec", "seed"), 7, "seed is 0, but 7 in run test of benchmark small"),
        (("n",), 36, "labels: are 32, but 36"),
        (("digests", "labels"), "0" * 64, "labels: have the digest"),
        (("digests", "candidates"), "0" * 64, "candidates: have the digest"),
    ],
)
def test_a_run_that_differs_is_refused_with_its_differences(
    small_benchmark: Path, tmp_path: Path, path: tuple[str, ...], value: Any, told: str,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    runs = changed_runs(small_benchmark, tmp_path / "runs", path, value)
    not_scored(capsys, runs, "proximity", told)


@pytest.mark.parametrize(("field", "array"), [("object_digests", "object_digest"), ("house_ids", "house_id")])
def test_models_that_saw_held_out_houses_or_objects_are_refused(
    small_benchmark: Path, tmp_path: Path, field: str, array: str, capsys: pytest.CaptureFixture[str]
) -> None:
    first = np.ravel(arrays_of(small_benchmark / "test")[array])[0]
    model = checkpoint(tmp_path / "model.ckpt", **{field: (str(first),)})
    runs = changed_runs(small_benchmark, tmp_path / "runs", ("objects",), "test")
    not_scored(capsys, runs, model, "was trained on")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "line 1: is not sample_id,score"),
        ("sample_id,score\n", "sample_id: has no score for "),
        ("sample_id,score\nab,1\n", "line 2: is not an id of 32 hexadecimal digits and a score"),
        (f"sample_id,score\n{'0' * 32},x\n", "line 2: score 'x' is not a finite number"),
        (f"sample_id,score\n{'0' * 32},nan\n", "line 2: score 'nan' is not a finite number"),
        (f"sample_id,score\n{'0' * 32},1\n{'0' * 32},1\n", "line 3: scores 0000"),
        (f"# threshold: y\nsample_id,score\n{'0' * 32},1\n", "line 1: threshold 'y' is not"),
        (f"# Threshold = 0.3\nsample_id,score\n{'0' * 32},1\n", "line 1: states no threshold. Write # thr"),
        (f"# threshold: 1\n# threshold: 2\nsample_id,score\n{'0' * 32},1\n", "line 2: states the thr"),
        (f"sample_id,score\n{'0' * 32},7\n", "is no probability, and no threshold is stated"),
    ],
)
def test_a_broken_file_of_scores_is_one_line(
    text: str, told: str, small_benchmark: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.csv").write_bytes(text.encode("latin-1"))
    not_scored(capsys, small_benchmark, str(tmp_path / "mine.csv"), told)


@pytest.mark.parametrize(
    ("method", "told"),
    [
        ("nothing.ckpt", "METHOD: nothing.ckpt: is no file and no baseline. Give released"),
        ("scalars", "needs runs to fit its parameters on"),
    ],
)
def test_an_unknown_method_is_one_line(
    method: str, told: str, small_benchmark: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    not_scored(capsys, small_benchmark, method, told)


def test_a_file_states_its_threshold(
    small_benchmark: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = small_benchmark
    write_near(runs, tmp_path / "low.csv", "test", "grids")
    text = (tmp_path / "low.csv").read_text()
    scores = np.array([float(line.split(",")[1]) for line in text.splitlines()[1:33]])
    threshold = float(np.median(scores))
    head, *lines = text.splitlines()  # ids in capitals, and the empty lines of a writer on Windows
    text = "\r\r\n".join([f"# threshold: {threshold}", head, *map(str.upper, lines), ""])
    (tmp_path / "high.csv").write_bytes(text.encode())
    report = scores_of(capsys, runs, str(tmp_path / "low.csv"), str(tmp_path / "high.csv"))
    told = report["parts"][0]["sets"]["in-range"]["methods"]
    assert told["low"]["area_under_roc"] == told["high"]["area_under_roc"]
    label = arrays_of(runs / "test")["label"] == 1  # all of them are clear and within reach
    expected = np.mean([((scores >= threshold) == label)[label == side].mean() for side in (True, False)])
    assert told["high"]["balanced_accuracy"]["value"] == pytest.approx(expected)
    assert told["high"]["expected_calibration_error"] is None
    assert [m["threshold"] for m in report["methods"]] == [0.5, threshold]


def test_the_code_of_the_documents_writes_scores_without_this_project(
    small_benchmark: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = Path(__file__).parents[3] / "docs" / "results" / "benchmark.md"
    (code,) = [
        code
        for block in page.read_text().split("```python\n")[1:]
        if "data.zarr" in (code := block.split("```")[0])
    ]
    assert len(code.strip().splitlines()) <= 12
    (tmp_path / "runs").symlink_to(small_benchmark)
    alone = "import sys; sys.modules['datagen'] = None\n" + code
    subprocess.run([sys.executable, "-I", "-c", alone], cwd=tmp_path, check=True)
    report = scores_of(capsys, small_benchmark, str(tmp_path / "mine.csv"))
    assert report["parts"][0]["sets"]["in-range"]["methods"]["mine"]["area_under_roc"]["value"] > 0


def test_whole_grids_of_all_runs_are_divided_by_place() -> None:
    columns = make_columns(np.random.default_rng(1), 9, 16)
    columns = replace(columns, is_grid=np.arange(9) != 2, run=np.arange(9))
    parts = {part.title: part.columns for part in parts_by_place(columns)}
    assert {title: some.run.tolist() for title, some in parts.items()} == {
        "grids, top": [0, 4, 6, 8],
        "grids, shelf": [1, 3, 5, 7],
    }
    assert not parts_by_place(replace(columns, place=np.zeros(9, np.uint8)))

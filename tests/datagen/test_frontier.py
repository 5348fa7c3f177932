"""`datagen frontier` as a user calls it: real small runs, resuming, refusals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from datagen import cli
from tests.conftest import once
from tests.refusals import refused
from tests.sim_extra import SIM_INSTALLED, needs_sim
from tests.small_runs import CONFIG, json_of, make_small_run
from tests.train.conftest import ARM, heuristic_run

__all__ = ["heuristic_run"]
PLANS, JUDGED = 36, 24  # labels to train on, and of the test
SHARES = ("--shares", "0.5", "--shares", "1")


@pytest.fixture(scope="module")
def runs(shared_folder: Path) -> Path:
    """Heuristic and plan labels in training houses, and plan labels in validation and test houses."""
    if not SIM_INSTALLED:
        pytest.skip("the extra `sim` is not installed")
    return once(shared_folder / "frontier", lambda: make_runs(shared_folder / "frontier"))


def make_runs(folder: Path) -> None:
    folder.mkdir()
    make_small_run(folder / "heuristic", 96, "--split", "train", per_scene=16)
    file = folder / "plan.toml"
    file.write_text(CONFIG + ARM)
    for split, n in (("train", PLANS), ("val", 18), ("test", JUDGED)):
        words = ["submit", "plan", "--n", str(n), "--out", str(folder / split), "--split", split]
        more = ["--candidates", "in-range", "--candidates-per-scene", "6", "--workers", "0"]
        assert cli.run([*words, *more, "--config", str(file)]) == 0


def words(runs: Path, out: Path, *more: str) -> list[str]:
    given = ["frontier", str(runs / "heuristic"), str(runs / "train"), "--val", str(runs / "val")]
    return [*given, "--test", str(runs / "test"), "--out", str(out), *SHARES, *more]


@pytest.mark.slow
def test_a_frontier_of_real_runs_resumes_and_says_what_to_buy(
    runs: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    small = ("--seeds", "1", "--bootstrap", "20", "--workers", "1")
    first = json_of(capfd, words(runs, out, *small))
    made = {path: path.stat().st_mtime_ns for path in (out / "trainings").iterdir()}
    names = [point["trained_on"] for point in first["points"]]
    assert names == ["heuristic"] * 2 + ["plan"] * 2 + ["heuristic, plan"] * 2 + ["50% heuristic, plan"] * 2
    assert len(made) == 8
    last = first["points"][5]
    assert last["labels"] == {"heuristic": 96, "plan": PLANS}
    costs = first["label_costs"]
    spent_s = 96 * costs["heuristic"]["cpu_s"] + PLANS * costs["plan"]["cpu_s"]
    assert last["label_cpu_h"] == pytest.approx(spent_s / 3600)
    assert first["test_set"] == {
        "candidates": JUDGED,
        "scenes": JUDGED // 6,
        "positives": first["test_set"]["positives"],
    }
    assert {gain["source"] for gain in first["stage1"]} == {"plan"} and len(first["stage1"]) == 2
    assert sum(first["advice"]["wins"].values()) == pytest.approx(1)
    assert json.loads((out / "frontier.json").read_text()) == first
    drawn = ElementTree.parse(out / "frontier.svg").getroot()
    assert drawn.tag.endswith("svg")

    again = json_of(capfd, words(runs, out, *small))
    assert again == first
    assert {path: path.stat().st_mtime_ns for path in (out / "trainings").iterdir()} == made
    # Another seed adds trainings, and two processes make the same of what is made again.
    removed = next(iter(made))
    before = made_by_training(removed)
    removed.unlink()
    assert cli.run(words(runs, out, "--seeds", "2", "--bootstrap", "20", "--workers", "2")) == 0
    told = capfd.readouterr().out
    assert "core-hour" in told and "trained on" in told
    now = set((out / "trainings").iterdir())
    assert len(now) == 16 and set(made) < now
    again_made = made_by_training(removed)
    assert before.keys() == again_made.keys() and len(before) > 3
    for name in before:
        np.testing.assert_array_equal(before[name], again_made[name], err_msg=name)


def made_by_training(path: Path) -> dict[str, Any]:
    """Weights and scores; the record beside them has measured times."""
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files if name != "record"}


@needs_sim
def test_one_source_and_a_target_need_no_heuristic_labels(
    runs: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    arguments = ["frontier", str(runs / "train"), "--val", str(runs / "val"), "--test", str(runs / "test")]
    more = ["--shares", "0.3", *SHARES, "--seeds", "1", "--bootstrap", "10", "--target-accuracy", "0.99"]
    report = json_of(capfd, [*arguments, "--out", str(tmp_path / "out"), "--workers", "1", *more])
    assert [point["labels"] for point in report["points"]][-1] == {"plan": PLANS}
    assert report["stage1"] == [] and report["stage1_worth"] is None
    assert report["target"]["accuracy"] == 0.99 and len(report["sentences"]) == 2


def test_odd_calls_are_refused(
    runs: Path, heuristic_run: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    plain, out = words(runs, tmp_path / "out"), str(tmp_path / "out")
    for more, told in (
        (("--budget", "0cpu-h"), "allows nothing"),
        (("--budget", "20"), "Give CPU time"),
        (("--budget", "2h"), "is a time, in which any number of cores may work"),
        (("--budget", "2000000cpu-h"), "more than 1,000,000 core-hours"),
        (("--budget", "3eur"), "the prices are in USD"),
        (("--target-accuracy", "80"), "0.5 to 1"),
        (("--seeds", "0"), "--seeds"),
        (("--shares", "0.7"), "ascending shares"),
        (("--prices", str(tmp_path / "none.toml")), "none.toml"),
    ):
        refused([*plain, *more], capfd, told)
    judged = ["--val", str(runs / "val"), "--test", str(runs / "test"), "--out", out]
    refused(["frontier", str(runs / "heuristic"), *judged], capfd, "all have heuristic labels")
    swapped = ["--val", str(heuristic_run), "--test", str(runs / "test"), "--out", out]
    message = "is heuristic: models are judged on plan or sim labels"
    refused(["frontier", str(runs / "train"), *swapped], capfd, message)
    same = ["--val", str(runs / "val"), "--test", str(runs / "train"), "--out", out]
    refused(["frontier", str(runs / "train"), *same], capfd, "house")
    assert not Path(out).exists()

"""`datagen calibrate`: a rule from labels of trials, in a file that submit and relabel take as it is."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen import cli
from datagen.schemas.run import Run
from datagen.schemas.specification import CandidateParams, HeuristicParams, ScenesFrom, Specification
from datagen.workers.labels.distance_visibility_score import heuristic
from tests.columns import columns_of
from tests.made_runs import make_run, small_spec
from tests.refusals import refused
from tests.small_runs import arrays_of, json_of, submit_arguments
from tests.train.conftest import heuristic_run, sim_run  # noqa: F401 (fixtures)

N = 300
SAMPLE_FIELDS = ("base_is_clear", "label", "distance_m", "mount_distance_m", "arm_reach_m", "visibility")


def trial_spec(seed: int = 0, split: Any = "val", **changes: Any) -> Specification:
    return small_spec(seed, label_source="sim").model_copy(update={"split": split, **changes})


@pytest.fixture(scope="module")
def trials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """60 scenes of random rows that call themselves sim labels. Tests only read it."""
    out = tmp_path_factory.mktemp("trials") / "run"
    make_run(out, N, spec=trial_spec())
    return out


def calibrated(run: Path, out: Path, capture: pytest.CaptureFixture[str], *more: str) -> Any:
    return json_of(capture, ["calibrate", str(run), "--out", str(out), *more])


def rule_in(file: Path) -> HeuristicParams:
    fields = tomllib.loads(file.read_text())
    assert fields.keys() == {"heuristic"}
    assert fields["heuristic"].keys() == HeuristicParams.model_fields.keys()  # it is the whole rule
    return HeuristicParams.model_validate(fields["heuristic"])


def test_submit_and_relabel_take_the_file(
    sim_run: Path,  # noqa: F811
    heuristic_run: Path,  # noqa: F811
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = tmp_path / "rule.toml"
    told = calibrated(sim_run, file, capsys, "--candidates", "in-range", "--distance", "mount-over-reach")
    rule = rule_in(file)
    assert rule.model_dump() == told["heuristic"]["after"]
    assert (rule.distance, rule.d_min, rule.d_max) == ("mount-over-reach", 0.0, 1.0)
    assert told["heuristic"]["before"] == HeuristicParams().model_dump()

    relabelled = tmp_path / "relabelled"
    assert cli.run(["relabel", str(heuristic_run), "--out", str(relabelled), "--config", str(file)]) == 0
    assert Run.open(relabelled).manifest.spec.heuristic == rule
    stored = arrays_of(relabelled)
    inputs = (stored[n] for n in ("distance_m", "mount_distance_m", "arm_reach_m", "visibility"))
    np.testing.assert_array_equal(stored["label"], heuristic(*inputs, rule)[1])

    made = tmp_path / "made"
    # A small run's own configuration and the rule in one file: both sections are taken.
    arguments = submit_arguments(made, 8, config=file.read_text() + "\n[observation]\nn_points = 256\n")
    assert cli.run(arguments) == 0
    assert Run.open(made).manifest.spec.heuristic == rule


def test_what_is_told_is_so(trials: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = calibrated(trials, tmp_path / "rule.toml", capsys)
    [rows] = [
        {name: np.concatenate([s[name] for s in shards]) for name in shards[0]}
        for shards in [columns_of(trials, ("house_id", *SAMPLE_FIELDS))]
    ]
    clear = rows["base_is_clear"]
    label = rows["label"][clear] == 1
    assert (told["samples"], told["positives"]) == (clear.sum(), label.sum())
    assert told["houses"] == len(told["folds"]) == 5
    inputs = [rows[n][clear] for n in ("distance_m", "mount_distance_m", "arm_reach_m", "visibility")]
    for name, params in (("before", told["heuristic"]["before"]), ("fitted", told["heuristic"]["after"])):
        said = heuristic(*inputs, HeuristicParams(**params))[1] == 1
        assert told[name]["accuracy"]["value"] == pytest.approx((said == label).mean())
    after, before = (told[name]["accuracy"]["value"] for name in ("after", "before"))
    assert told["gain"]["accuracy"]["value"] == pytest.approx(after - before)


def test_the_file_says_where_it_comes_from_and_is_the_same_again(
    trials: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    texts: list[str] = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        told = calibrated(trials, Path("rule.toml"), capsys)
        texts.append(Path("rule.toml").read_text())
    assert texts[0] == texts[1]
    head = "\n".join(line for line in texts[0].splitlines() if line.startswith("# "))
    share = f"{100 * told['after']['balanced_accuracy']['value']:.1f}"
    for word in (Run.open(trials).manifest.spec_hash, f"n {told['samples']}", "split val", share):
        assert word in head


def test_runs_are_calibrated_to_together_and_odd_splits_are_said(
    trials: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "a\nname"
    make_run(other, 50, spec=trial_spec(1, "test"))
    out = tmp_path / "rule.toml"
    words = ["calibrate", str(trials), str(other), "--out", str(out), "--candidates", "grid"]
    assert cli.run([*words, "--json"]) == 0
    shown = capsys.readouterr()
    told = json.loads(shown.out)
    assert (told["samples"], told["scenes"]) == (N + 50, 70)
    assert "warning: " in shown.err and "split is test" in shown.err
    assert rule_in(out).model_dump() == told["heuristic"]["after"]  # whatever the run's name
    assert "split test" in out.read_text()


def test_what_cannot_be_fitted_to_is_refused(
    trials: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def made(name: str, spec: Specification, n: int = 5) -> str:
        make_run(tmp_path / name, n, spec=spec)
        return str(tmp_path / name)

    out = ["--out", str(tmp_path / "rule.toml")]
    refused(["calibrate", *out], capsys, "runs")
    refused(["calibrate", made("rules", small_spec()), *out], capsys, "label_source", "rule itself")
    refused(["calibrate", str(trials), str(trials), *out], capsys, "scenes", "another run")
    view = trial_spec(scenes_from=ScenesFrom(spec_hash=Run.open(trials).manifest.spec_hash, view=1))
    refused(["calibrate", str(trials), made("view", view), *out], capsys, "scenes", "another run")
    planned = small_spec(1, label_source="plan")
    refused(["calibrate", str(trials), made("plan", planned), *out], capsys, "plan", "sim")
    ruled = trial_spec(2, heuristic=HeuristicParams(mu=0.6))
    refused(
        ["calibrate", str(trials), made("ruled", ruled), *out], capsys, "heuristic", "differs from that of"
    )
    near = trial_spec(3, candidates=CandidateParams(within="in-range", per_scene=5))
    refused(["calibrate", made("near", near), *out], capsys, "in-range", "clear")
    refused(["calibrate", made("one", trial_spec(4), 1), *out, "--candidates", "grid"], capsys, "label")
    refused(["calibrate", made("few", trial_spec(5), 30), *out], capsys, "scenes")
    assert not (tmp_path / "rule.toml").exists()


@pytest.mark.parametrize(
    ("out", "distance", "told"),
    [
        ("rule.txt", "planar", "a .toml file"),
        ("nowhere/rule.toml", "planar", "folder"),
        ("rule.toml", "crow", "--distance"),
        ("there.toml", "planar", "there.toml: --out: already exists"),
    ],
)
def test_odd_options_are_refused_and_a_file_that_is_there_stays(
    out: str, distance: str, told: str, trials: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "there.toml").write_text("mine")
    refused(["calibrate", str(trials), "--out", str(tmp_path / out), "--distance", distance], capsys, told)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]

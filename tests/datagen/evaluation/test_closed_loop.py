"""`datagen evaluate --closed-loop` on whole grids of the built-in world."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen import cli
from datagen.evaluation import arrival_outcomes
from datagen.evaluation.arrival_outcomes import SceneTask, read_outcomes
from datagen.schemas.fields import OUTCOMES
from datagen.schemas.run import Run
from tests.refusals import refused
from tests.sim_extra import needs_sim
from tests.small_runs import GRID_CONFIG, arrays_of, json_of

pytestmark = needs_sim

SIDE, SCENES = 7, 5
GRID = GRID_CONFIG.format(side=SIDE) + "\n[scene]\nplaces = {}\nn_clutter = 1\n"
QUICK = ("--baselines", "proximity", "--baselines", "analytic")
NEAR, FAR = "disc:0", "normal:0.1,3deg"


@pytest.fixture(scope="module")
def grids(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("loop")
    (folder / "grid.toml").write_text(GRID)
    return submit(folder / "run", folder / "grid.toml", SCENES, 4)


def submit(out: Path, config: Path, scenes: int, seed: int) -> Path:
    n, where = str(scenes * SIDE**2), ["--out", str(out), "--config", str(config), "--workers", "0"]
    words = ["submit", "plan", "--n", n, "--candidates-per-scene", "grid", "--seed", str(seed)]
    assert cli.run([*words, *where]) == 0
    return out


def words(grids: Path, out: Path, *more: str, workers: int = 0, scenes: int = 2) -> list[str]:
    errors = ["--arrival", NEAR, "--arrival", FAR]
    sizes = ["--workers", str(workers), "--closed-loop", str(scenes)]
    return ["evaluate", str(grids), "--out", str(out / "loop.json"), *sizes, *errors, *QUICK, *more]


def outcomes_in(out: Path) -> dict[str, dict[str, str]]:
    return {p.name: json.loads(p.read_text())["outcomes"] for p in sorted((out / "loop.arrivals").iterdir())}


@pytest.fixture(scope="module")
def made(grids: Path) -> Path:
    """A loop of plans in this process."""
    out = grids.parent / "made"
    out.mkdir()
    assert cli.run(words(grids, out)) == 0
    return out


@pytest.mark.slow
def test_without_error_the_outcome_is_the_label_and_two_processes_give_the_same(
    grids: Path, made: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    report = json.loads((made / "loop.json").read_text())["closed_loop"]
    stored = arrays_of(grids)
    label = stored["label"].reshape(SCENES, SIDE**2) == 1
    clear = stored["base_is_clear"].reshape(label.shape)
    good = (label & clear).any(axis=1)
    assert report["scenes_without_good"] == int((~good).sum())
    assert report["parts"][0]["scenes"] == 2 <= int(good.sum())
    exact, missed = report["parts"][0]["table"]
    assert exact["distance_m"] == 0 and missed["distance_m"] == pytest.approx(0.14, abs=0.01)
    for of_method in exact["methods"].values():
        for told in of_method.values():
            assert told["value"] + sum(told["failures"].values()) == pytest.approx(1)
    assert all(told["value"] == 1 for told in exact["methods"]["best by labels"].values())
    # Every outcome without an error is the stored one of that candidate.
    outcome = stored["outcome"].reshape(label.shape)
    scenes = np.flatnonzero(good)[:2]
    for k, task_outcomes in zip(scenes, by_scene(made, grids, scenes), strict=True):
        for key, told in task_outcomes.items():
            candidate, *error = key.split(" ")
            if not any(map(float, error)):
                assert list(OUTCOMES)[outcome[k, int(candidate)]] == told
    assert json_of(capfd, words(grids, tmp_path, workers=2))["closed_loop"] == report
    assert outcomes_in(tmp_path) == outcomes_in(made)


def by_scene(made: Path, grids: Path, scenes: Any) -> list[dict[str, str]]:
    """The outcomes of scenes, by the name that each scene's file has."""
    run = Run.open(grids)
    places = ("builtin", "builtin", "")  # houses, objects, robot
    tasks = [
        SceneTask(
            run.storage.url, run.manifest.spec, *places, int(k), "plan", 0, str(made / "loop.arrivals"), ()
        )
        for k in scenes
    ]
    return [read_outcomes(task.path) for task in tasks]


def test_the_same_command_resumes_after_an_interrupt_and_makes_nothing_twice(
    grids: Path,
    made: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole, calls, out = outcomes_in(made), 0, tmp_path
    n = sum(map(len, whole.values()))
    real = arrival_outcomes.try_arrival

    def counted(*given: Any) -> str:
        nonlocal calls
        calls += 1
        if calls == 5:
            os.kill(os.getpid(), signal.SIGINT)
        return real(*given)

    monkeypatch.setattr(arrival_outcomes, "try_arrival", counted)
    assert cli.run(words(grids, out)) == 130
    assert "finished arrivals are kept" in capfd.readouterr().err
    kept = outcomes_in(out)
    assert sum(map(len, kept.values())) == 5 and all(
        kept[name].items() <= whole[name].items() for name in kept
    )
    first = json_of(capfd, words(grids, out))["closed_loop"]
    assert calls == n and outcomes_in(out) == whole
    assert first == json.loads((made / "loop.json").read_text())["closed_loop"]
    # Another method makes only its own arrivals; equal ones are there already.
    more = json_of(capfd, words(grids, out, "--baselines", "threshold-visibility"))["closed_loop"]
    assert calls > n
    wider = outcomes_in(out)
    assert all(whole[name].items() <= wider[name].items() for name in whole)
    assert more["arrivals"]["distinct"] <= sum(map(len, wider.values())) == calls


def test_executed_trials_name_their_causes(
    grids: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    arguments = words(grids, tmp_path, "--execute", workers=1)
    report = json_of(capfd, arguments)["closed_loop"]
    assert (report["mode"], report["arrivals_per_scene"], report["parts"][0]["scenes"]) == ("sim", 1, 2)
    outcomes = {end for ends in outcomes_in(tmp_path).values() for end in ends.values()}
    assert outcomes <= set(OUTCOMES) and "success" in outcomes
    assert cli.run(arguments) == 0
    told = capfd.readouterr().out
    assert "executes in a disturbed world" in told and "random in reach" in told


def test_scenes_of_merged_runs_are_found(
    grids: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    other, merged = submit(tmp_path / "other", grids.parent / "grid.toml", 2, 5), tmp_path / "merged"
    assert cli.run(["merge", str(grids), str(other), "--out", str(merged)]) == 0
    report = json_of(capfd, words(merged, tmp_path, scenes=99))["closed_loop"]
    assert report["parts"][0]["scenes"] + report["scenes_without_good"] == SCENES + 2


def test_bad_input_is_refused(
    grids: Path, made: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    refused(words(grids, tmp_path, workers=999), capfd, "--workers")
    refused(["evaluate", str(grids), "--closed-loop", "1", *QUICK], capfd, "--out: is missing")
    fitted = ["--fit", str(grids), "--allow-seen-houses", "--baselines", "distance"]
    loop = ["--closed-loop", "2", "--out", str(tmp_path / "seen.json")]
    refused(["evaluate", str(grids), *fitted, *loop], capfd, "whole grids, in unseen houses, has")
    near, config = str(tmp_path / "near"), str(grids.parent / "grid.toml")
    drawn = ["--candidates", "in-range", "--candidates-per-scene", "7", "--n", "14", "--workers", "0"]
    assert cli.run(["submit", "plan", *drawn, "--out", near, "--config", config]) == 0
    refused(words(Path(near), tmp_path), capfd, "no scene has a whole grid")
    (tmp_path / "loop.arrivals").mkdir()
    for path in (made / "loop.arrivals").iterdir():
        (tmp_path / "loop.arrivals" / path.name).write_text('{"outcomes": {"0 0 0 0 0": "fine"}}')
    refused(words(grids, tmp_path), capfd, "outcomes", "Remove this file")

"""`datagen closed-loop` as a user calls it, on whole grids of the built-in world."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen import cli
from datagen.closed_loop import arrivals_of_scene
from datagen.schemas.outcomes import OUTCOMES
from tests.refusals import refused
from tests.sim_extra import needs_sim
from tests.small_runs import GRID_CONFIG, arrays_of, json_of

pytestmark = needs_sim

SIDE, SCENES = 7, 5
GRID = GRID_CONFIG.format(side=SIDE) + "\n[scene]\nn_clutter = 1\n"
QUICK = ("--bootstrap", "30", "--baselines", "proximity", "--baselines", "analytic", "--repeats", "2")
NEAR, FAR = "disc:0", "normal:0.1,3deg"


@pytest.fixture(scope="module")
def grids(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("loop")
    (folder / "grid.toml").write_text(GRID)
    where = ["--out", str(folder / "run"), "--config", str(folder / "grid.toml"), "--workers", "0"]
    n = str(SCENES * SIDE**2)
    assert cli.run(["submit", "plan", "--n", n, "--candidates-per-scene", "grid", "--seed", "4", *where]) == 0
    return folder / "run"


def words(
    grids: Path, out: Path, *more: str, mode: str = "plan", workers: int = 0, scenes: int = 2
) -> list[str]:
    errors = ["--arrival", NEAR, "--arrival", FAR]
    sizes = ["--workers", str(workers), "--scenes", str(scenes)]
    return ["closed-loop", str(grids), "--out", str(out), "--mode", mode, *sizes, *errors, *QUICK, *more]


def outcomes_in(out: Path) -> dict[str, dict[str, str]]:
    return {p.name: json.loads(p.read_text())["outcomes"] for p in sorted((out / "arrivals").iterdir())}


@pytest.fixture(scope="module")
def made(grids: Path) -> Path:
    """A loop of plans in this process."""
    out = grids.parent / "made"
    assert cli.run(words(grids, out)) == 0
    return out


@pytest.mark.slow
def test_without_error_a_pick_comes_to_its_label_and_two_processes_make_the_same(
    grids: Path, made: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    report = json.loads((made / "closed-loop.json").read_text())
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
            assert told["value"] == pytest.approx(told["by_labels"])
            assert told["value"] + sum(told["failures"].values()) == pytest.approx(1)
    assert all(told["value"] == 1 for told in exact["methods"]["best by labels"].values())
    agreed = report["agreement"][0]
    assert agreed["agree_with_nearest"] == 1 and agreed["success"] == agreed["nearest_label"]
    # Every outcome without an error is the stored one of that candidate.
    outcome = stored["outcome"].reshape(label.shape)
    scenes = np.flatnonzero(good)[:2]
    for k, task_outcomes in zip(scenes, by_scene(made, grids, scenes), strict=True):
        for key, told in task_outcomes.items():
            candidate, *error = key.split(" ")
            if not any(map(float, error)):
                assert list(OUTCOMES)[outcome[k, int(candidate)]] == told
    again = json_of(capfd, words(grids, tmp_path / "again", workers=2))
    assert again == report
    assert outcomes_in(tmp_path / "again") == outcomes_in(made)


def by_scene(made: Path, grids: Path, scenes: Any) -> list[dict[str, str]]:
    """The outcomes of scenes, by the name that each scene's file has."""
    from datagen.closed_loop.arrivals_of_scene import SceneTask, read_outcomes
    from datagen.schemas.run import Run

    run = Run.open(grids)
    places = ("builtin", "builtin")
    tasks = [
        SceneTask(run.storage.url, run.manifest.spec, *places, int(k), "plan", 0, str(made / "arrivals"), ())
        for k in scenes
    ]
    return [read_outcomes(task.path) for task in tasks]


def test_it_resumes_after_an_interrupt_and_makes_nothing_twice(
    grids: Path,
    made: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole, calls, out = outcomes_in(made), 0, tmp_path / "out"
    n = sum(map(len, whole.values()))
    real = arrivals_of_scene.try_arrival

    def counted(*given: Any) -> str:
        nonlocal calls
        calls += 1
        if calls == 5:
            os.kill(os.getpid(), signal.SIGINT)
        return real(*given)

    monkeypatch.setattr(arrivals_of_scene, "try_arrival", counted)
    assert cli.run(words(grids, out)) == 130
    assert "finished arrivals are kept" in capfd.readouterr().err
    kept = outcomes_in(out)
    assert sum(map(len, kept.values())) == 5 and all(
        kept[name].items() <= whole[name].items() for name in kept
    )
    first = json_of(capfd, words(grids, out))
    assert calls == n and outcomes_in(out) == whole
    assert first == json.loads((made / "closed-loop.json").read_text())
    # Another method makes only its own arrivals; equal ones are there already.
    more = json_of(capfd, words(grids, out, "--baselines", "threshold-detector"))
    assert calls > n
    wider = outcomes_in(out)
    assert all(whole[name].items() <= wider[name].items() for name in whole)
    assert more["arrivals"]["distinct"] <= sum(map(len, wider.values())) == calls
    for file in (out / "closed-loop.svg", out / "closed-loop.json"):
        assert file.stat().st_size > 1000


def test_trials_differ_between_worlds_and_name_their_causes(
    grids: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    arguments = words(grids, tmp_path, mode="sim", workers=1, scenes=1)
    report = json_of(capfd, arguments)
    assert report["mode"] == "sim" and report["parts"][0]["scenes"] == 1
    (outcomes,) = outcomes_in(tmp_path).values()
    assert set(outcomes.values()) <= set(OUTCOMES) and "success" in outcomes.values()
    # The same pose in two worlds is executed twice.
    still = [key for key in outcomes if key.split(" ")[1:4] == ["0.000000"] * 3]
    assert len({key.rsplit(" ", 1)[0] for key in still}) * 2 == len(still)
    assert cli.run(arguments) == 0
    told = capfd.readouterr().out
    assert "executes in a disturbed world" in told and "random in reach" in told


def test_scenes_of_merged_runs_are_found(
    grids: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    other, merged = tmp_path / "other", tmp_path / "merged"
    where = ["--out", str(other), "--config", str(grids.parent / "grid.toml"), "--workers", "0"]
    n = str(2 * SIDE**2)
    assert cli.run(["submit", "plan", "--n", n, "--candidates-per-scene", "grid", "--seed", "5", *where]) == 0
    assert cli.run(["merge", str(grids), str(other), "--out", str(merged)]) == 0
    some = ["--arrival", NEAR, *QUICK, "--mode", "plan", "--workers", "0"]
    report = json_of(capfd, ["closed-loop", str(merged), "--out", str(tmp_path / "out"), *some])
    assert report["parts"][0]["scenes"] + report["scenes_without_good"] == SCENES + 2
    assert report["agreement"][0]["agree_with_nearest"] == 1


def test_odd_calls_are_refused(
    grids: Path, made: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for more, told in (
        (("--workers", "-1"), "--workers"),
        (("--scenes", "0"), "--scenes"),
        (("--workers", "999"), "--workers"),
        (("--arrival", "ring:1"), "--arrival"),
    ):
        refused(["closed-loop", str(grids), "--out", str(tmp_path), *QUICK, *more], capfd, told)
    file = grids.parent / "grid.toml"
    refused(["closed-loop", str(grids), "--out", str(file), *QUICK], capfd, "is not a folder")
    none = ["--baselines", "none", "--bootstrap", "30"]
    refused(["closed-loop", str(grids), "--out", str(tmp_path), *none], capfd, "no model or baseline given")
    (grids.parent / "near.toml").write_text(GRID)
    near = str(tmp_path / "near")
    drawn = ["--candidates", "in-range", "--candidates-per-scene", "3", "--n", "3", "--workers", "0"]
    assert (
        cli.run(["submit", "plan", *drawn, "--out", near, "--config", str(grids.parent / "near.toml")]) == 0
    )
    refused(["closed-loop", near, "--out", str(tmp_path), *QUICK], capfd, "no scene has a whole grid")
    out = tmp_path / "damaged"
    (out / "arrivals").mkdir(parents=True)
    for path in (made / "arrivals").iterdir():
        (out / "arrivals" / path.name).write_text('{"outcomes": {"0 0 0 0 0": "fine"}}')
    refused(words(grids, out), capfd, "outcomes", "Remove this file")

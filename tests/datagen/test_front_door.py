"""`import datagen`: cheap, lazily loaded, documented by examples that run."""

from __future__ import annotations

import doctest
import json
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch

import datagen
from datagen import cli
from datagen.cluster.attempt import run_attempt
from datagen.cluster.attempt_guard import Meter
from datagen.cluster.protocol import AttemptResult, ShardTask
from datagen.jobs import job
from datagen.sources import Registry
from tests.small_runs import CONFIG, make_small_run
from tests.train.conftest import sim_run
from tests.train.prediction.checkpoints import write_untrained
from tests.train.prediction.seen_scenes import MODEL, camera_arrays, draw_seen, write_frame

__all__ = ["sim_run"]

FUNCTIONS = [n for n in datagen.__all__ if callable(getattr(datagen, n)) and n.islower()]


def in_new_python(code: str) -> Any:
    """What the code prints as JSON, in a process that has imported nothing."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_importing_loads_no_library_and_none_of_our_modules() -> None:
    code = "import datagen, json, sys; dir(datagen); print(json.dumps(sorted(sys.modules)))"
    modules = in_new_python(code)
    assert {"cyclopts", "numpy", "pandas", "pydantic", "ray", "sapien"}.isdisjoint(modules)
    assert {"torch", "trimesh", "xarray", "zarr"}.isdisjoint(modules)
    assert [name for name in modules if name.partition(".")[0] == "datagen"] == ["datagen"]


@pytest.mark.parametrize("name", ["open_dataset", "candidates", "robots", "Run", "InputError"])
def test_reading_runs_needs_neither_ray_nor_torch_nor_a_simulator(name: str) -> None:
    code = f"import datagen, json, sys; datagen.{name}; print(json.dumps(sorted(sys.modules)))"
    assert {"ray", "torch", "sapien", "pybullet", "trimesh", "mani_skill"}.isdisjoint(in_new_python(code))


def test_every_name_is_there_and_documented() -> None:
    assert dir(datagen) == datagen.__all__ == sorted(datagen.__all__)
    for name in datagen.__all__:
        value = getattr(datagen, name)
        assert name == "__version__" or value.__doc__
        assert name not in FUNCTIONS or "Examples:" in value.__doc__


def test_an_unknown_name_lists_the_others() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'sumbit'\. It offers: InputError, JobResult"):
        _ = datagen.sumbit  # type: ignore[attr-defined]


def test_the_command_line_calls_the_same_functions() -> None:
    verbs = {"submit", "resume", "merge", "evaluate", "predict"}
    for verb in verbs:
        home, _ = cli.VERBS[verb][0].split(":")
        assert getattr(datagen, verb).__module__ == home
    assert datagen.train_model.__module__ == cli.VERBS["train"][0].split(":")[0]


def test_registries_have_names_and_refuse_others_with_the_valid_ones() -> None:
    assert (
        list(datagen.houses) == ["ai2thor", "builtin", "habitat", "map", "procthor"]
        and len(datagen.objects) == 3
    )
    assert "sim" in datagen.label_sources and "tiago" not in datagen.robots
    assert datagen.label_sources["heuristic"].name == "heuristic"
    with pytest.raises(datagen.InputError, match="Choose one of: fetch, panda, panda-scaled, pr2"):
        datagen.robots["tiago"]
    assert repr(datagen.objects) == "Registry(builtin, folder, ycb)"


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The names that the examples in docstrings use."""
    folder = tmp_path_factory.mktemp("docs")
    run = make_small_run(folder / "run", 16)
    other = make_small_run(folder / "other", 16, "--seed", "1")
    checkpoint = folder / "untrained.ckpt"
    write_untrained(checkpoint, MODEL)
    seen = draw_seen(0)
    frame = write_frame(folder / "frame", seen)
    names = {"folder": folder, "run": run, "other": other, "checkpoint": checkpoint, "frame": frame}
    return {"datagen": datagen, "torch": torch, **names, "camera": camera_arrays(seen)}


@pytest.mark.parametrize("name", [*FUNCTIONS, "Registry"])
def test_the_examples_in_docstrings_run(
    name: str, world: dict[str, Any], request: pytest.FixtureRequest
) -> None:
    if name == "evaluate":
        world = world | {"sim_run": request.getfixturevalue("sim_run")}
    value = Registry if name == "Registry" else getattr(datagen, name)
    tests = doctest.DocTestFinder(recurse=False).find(value, name, module=False, globs=dict(world))
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    said: list[str] = []
    for test in tests:
        runner.run(test, out=said.append)
    assert runner.summarize(verbose=False).failed == 0, "".join(said)
    assert runner.tries, "no example"


def test_a_job_returns_what_it_did_and_prints_nothing_when_quiet(
    world: dict[str, Any], capfd: pytest.CaptureFixture[str]
) -> None:
    result = datagen.resume(world["run"], workers=0, quiet=True)
    assert (result.complete, result.n, result.labels, result.remaining) == (True, 16, 0, 0)
    assert result.store == str(world["run"] / "data.zarr") and Path(result.store).is_dir()
    assert capfd.readouterr() == ("", "")


def test_an_interrupt_leaves_a_run_that_the_same_call_finishes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "small.toml").write_text(CONFIG)

    def submit() -> datagen.JobResult:
        return datagen.submit(
            "heuristic",
            n=32,
            out=tmp_path / "run",
            candidates_per_scene=8,
            config=tmp_path / "small.toml",
            workers=0,
            quiet=True,
        )

    began: list[int] = []

    def interrupted(task: ShardTask, meter: Meter) -> AttemptResult:
        began.append(task.shard)
        if len(began) == 1:
            os.kill(os.getpid(), signal.SIGINT)  # as Ctrl-C, or a notebook's stop button
        return run_attempt(task, meter)

    with monkeypatch.context() as patched:
        patched.setattr(job, "run_attempt", interrupted)
        with pytest.raises(KeyboardInterrupt, match=r"shards? left\. Resume with: datagen resume"):
            submit()
    made = len(datagen.candidates(tmp_path / "run", allow_incomplete=True))
    assert made == 8 * len(began) < 32  # shards that were in flight are finished
    with ThreadPoolExecutor(1) as pool:  # where no signal arrives
        result = pool.submit(submit).result()
    assert (result.complete, result.labels) == (True, 32 - made)
    assert len(datagen.candidates(result.path)) == 32

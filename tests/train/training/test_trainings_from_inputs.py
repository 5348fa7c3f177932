"""`--encoded`: inputs are made once, trainings from them resume, and what does not go with it is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from datagen import cli
from datagen.schemas.errors import InputError
from datagen.train.training.checkpoints import read_checkpoint
from datagen.train.training.training_setup import prepare_training
from tests.small_runs import CONFIG
from tests.train.conftest import ARM, TRIED
from tests.train.training.small import TINY_PAPER, equal, job_of, train_until


def test_inputs_are_made_once_and_an_interrupted_training_ends_as_a_whole_one(
    heuristic_run: Path, tmp_path: Path
):
    inputs, seen = tmp_path / "inputs", list[int]()
    jobs = [replace(job_of(heuristic_run, tmp_path / name), encoded=str(inputs)) for name in ("a", "b")]
    prepare_training(jobs[0], lambda done, of: seen.append(done))
    made = {path: path.stat().st_mtime_ns for path in inputs.rglob("*") if path.is_file()}
    assert seen and made
    assert train_until(jobs[0])[0]
    assert not train_until(jobs[1], step=2)[0]
    assert train_until(jobs[1])[0]
    whole, resumed = (read_checkpoint(job.out) for job in jobs)
    assert equal(whole.weights, resumed.weights)
    assert whole.head.history == resumed.head.history
    assert {path: path.stat().st_mtime_ns for path in inputs.rglob("*") if path.is_file()} == made


def test_another_model_is_refused(heuristic_run: Path, tmp_path: Path):
    inputs = tmp_path / "inputs"
    other = job_of(heuristic_run, tmp_path / "model", model="paper", model_config=TINY_PAPER)
    asked = replace(other, encoded=str(inputs))
    with pytest.raises(InputError, match="--model"):
        prepare_training(asked)
    assert not inputs.exists()


def test_rates_of_either_side_are_refused(sim_run: Path, tmp_path: Path):
    """Encoded candidates have labels alone."""
    (tmp_path / "plan.toml").write_text(CONFIG + ARM)
    words = ["--candidates", "in-range", "--candidates-per-scene", str(TRIED), "--draws", "2", "--seed", "9"]
    words += ["--config", str(tmp_path / "plan.toml"), "--out", str(tmp_path / "plan"), "--workers", "0"]
    assert cli.run(["submit", "plan", "--n", str(2 * TRIED), *words]) == 0
    job = replace(job_of(sim_run, tmp_path / "model", stage="sim-only"), encoded=str(tmp_path / "inputs"))
    with pytest.raises(InputError, match="--draws"):
        prepare_training(replace(job, val_runs=(str(tmp_path / "plan"),)))

"""Several processes train like one: gloo on this machine, with two of them."""

from __future__ import annotations

import dataclasses
import os
import signal
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.schemas.errors import InputError
from datagen.train.training.checkpoints import read_checkpoint
from datagen.train.training.launching import Ranks, interruptible, train_in_processes
from datagen.train.training.loop import run_training
from datagen.train.training.training_setup import TrainingJob, prepare_training
from tests.train.training.rank_work import Union, results_of, train_and_save_results
from tests.train.training.small import TINY, equal, job_of

pytestmark = pytest.mark.slow

# Without dropout, whose draws are each rank's own.
STILL: dict[str, Any] = {**TINY, "dropout": 0.0}


def still_job(run_: Path, out: Path) -> TrainingJob:
    return job_of(run_, out, epochs=1, model_config=STILL)


def test_two_processes_train_like_one_on_both_their_batches_and_end_together(
    heuristic_run: Path, tmp_path: Path
):
    job = still_job(heuristic_run, tmp_path / "two.ckpt")
    with pytest.raises(InputError, match="place: field: problem"):
        train_in_processes(train_and_save_results, job, 2, "cpu", lambda: False)
    told = [results_of(job.out, rank) for rank in (0, 1)]
    kept = read_checkpoint(job.out)
    assert equal(told[0]["weights"], told[1]["weights"])
    assert equal(
        told[0]["weights"], {k.removeprefix("model."): v for k, v in kept.resume.items() if "model." in k}
    )
    ids = [{bytes(i) for i in t["ids"].numpy()} for t in told]
    assert not ids[0] & ids[1]
    assert len(ids[0] | ids[1]) == sum(r["n_samples"] for r in kept.head.data)

    ranks = [
        prepare_training(still_job(heuristic_run, tmp_path / "new.ckpt"), Ranks(r, 2))[0] for r in (0, 1)
    ]
    alone, _ = prepare_training(still_job(heuristic_run, tmp_path / "new.ckpt"), Ranks())
    union = Union([r.train for r in ranks])
    assert run_training(dataclasses.replace(alone, train=union), lambda: None)
    for name, value in alone.model.state_dict().items():
        np.testing.assert_allclose(value, told[0]["weights"][name], rtol=1e-3, atol=1e-5, err_msg=name)
    one, two = alone.position.history[0], kept.head.history[0]
    assert one.keys() == two.keys()
    for name, value in one.items():
        assert value == pytest.approx(two[name], rel=1e-4), name


WAITING = """
import sys
from pathlib import Path
from tests.train.training.rank_work import wait_for_stop
from datagen.train.training.launching import train_in_processes
job = sys.argv[1]
assert train_in_processes(wait_for_stop, job, 1, "cpu", lambda: Path(job + ".stop").exists())
"""


def test_the_next_training_removes_folders_of_killed_ones_alone(
    tmp_path: Path,
):
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    running: list[subprocess.Popen[bytes]] = []

    def begin(name: str) -> Path:
        """A training that has begun; its folder."""
        known = set(temporary.iterdir())
        command = [sys.executable, "-c", WAITING, str(tmp_path / name)]
        running.append(subprocess.Popen(command, env={**os.environ, "TMPDIR": str(temporary)}))
        while not (tmp_path / name).exists():
            assert running[-1].poll() is None
            time.sleep(0.05)
        (folder,) = set(temporary.glob("datagen-*")) - known
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        return folder

    try:
        dead = begin("killed")
        running[0].kill()
        running[0].wait()
        assert dead.is_dir()
        living = begin("living")
        assert not dead.exists()
        third = begin("third")
        assert living.is_dir() and third.is_dir()
        for name in ("living", "third"):
            (tmp_path / f"{name}.stop").touch()
        assert [process.wait() for process in running[1:]] == [0, 0]
        assert not list(temporary.glob("datagen-*"))
    finally:
        for process in running:
            process.kill()


def test_the_first_interrupt_is_noted_and_the_second_ends():
    assert threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), interruptible() as stopping:
        assert not stopping()
        os.kill(os.getpid(), signal.SIGINT)
        assert stopping()
        os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_steps_have_whole_scenes(heuristic_run: Path, tmp_path: Path):
    with pytest.raises(InputError, match="cannot be divided evenly among 3"):
        prepare_training(still_job(heuristic_run, tmp_path / "c.ckpt"), Ranks(0, 3))

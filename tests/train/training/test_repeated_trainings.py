"""With two threads as well, a training is the same bit for bit each time, and also if it was interrupted.

Sizes are such that torch divides the rows of one cloud between threads: in smaller models one thread does it
all, and nothing could differ.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils import deterministic

from datagen.schemas.errors import InputError
from datagen.train.training.checkpoints import Checkpoint, read_checkpoint
from datagen.train.training.loop import run_training
from datagen.train.training.training_setup import TrainingJob, prepare_training
from tests.small_runs import CONFIG, make_small_run
from tests.train.training.small import TINY, TINY_PAPER, equal, job_of, train_until

WIDE: dict[str, Any] = {**TINY, "width": 64, "hand_poses": 104}
KINDS: dict[str, dict[str, Any]] = {
    "stage1": {"model_config": WIDE},
    "encoded": {"model_config": WIDE},
    "stage2": {"model_config": WIDE, "stage": "stage2"},
    "paper": {"model": "paper", "model_config": {**TINY_PAPER, "widths": [[32], [32], [32]]}},
    "n2m": {"model": "n2m", "model_config": {"n_points": 64, "components": 256, "widths": [8], "head": [8]}},
}


@pytest.fixture(scope="module")
def one_robot_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """8 scenes, each with 24 candidates of one robot."""
    config = CONFIG + "\n[candidates]\nrobots_per_scene = 1\n"
    return make_small_run(tmp_path_factory.mktemp("run") / "one", 8 * 24, per_scene=24, config=config)


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def trained(job: TrainingJob, stop_at: int | None = None) -> Checkpoint:
    if stop_at is not None:
        assert not train_until(job, stop_at)[0]
    assert train_until(job)[0]
    return read_checkpoint(job.out)


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind == "stage2")) for kind in KINDS]
)
def test_a_training_is_repeated_and_resumed_bit_for_bit(
    kind: str, one_robot_run: Path, tmp_path: Path, request: pytest.FixtureRequest
):
    run, more = one_robot_run, dict[str, Any]()
    if kind == "encoded":
        more = {"encoded": str(tmp_path / "inputs")}
    if kind == "stage2":
        first = job_of(run, tmp_path / "first", epochs=1, model_config=WIDE, house_share=0.3)
        trained(first)
        run, more = request.getfixturevalue("sim_run"), {"init": first.out}
    chosen: dict[str, Any] = {"batch_scenes": 1, "epochs": 1, "house_share": 0.5, **KINDS[kind]}
    jobs = [replace(job_of(run, tmp_path / name, **chosen), **more) for name in ("whole", "again", "resumed")]
    whole, *others = (trained(job, stop) for job, stop in zip(jobs, (None, None, 2), strict=True))
    assert whole.head.step > 3
    for other in others:
        assert equal(other.resume, whole.resume)
        assert equal(other.weights, whole.weights)
        assert other.head.history == whole.head.history


@pytest.mark.parametrize("before", [0, 1, 2])
def test_the_process_is_afterwards_as_it_was(one_robot_run: Path, tmp_path: Path, before: int):
    """torch's mode is of the process: 0, its default; 1 warns where an operation cannot repeat; 2 fails."""
    memory: Any = deterministic
    training, _ = prepare_training(job_of(one_robot_run, tmp_path / "c"))
    seen: list[tuple[int, bool]] = []

    def stopping() -> bool:
        seen.append((torch.get_deterministic_debug_mode(), memory.fill_uninitialized_memory))
        return True

    try:
        torch.set_deterministic_debug_mode(before)
        assert not run_training(training, lambda: None, stopping=stopping)
        assert torch.get_deterministic_debug_mode() == before and memory.fill_uninitialized_memory
        next(iter(training.model.parameters())).register_hook(lambda gradient: gradient * float("nan"))
        with pytest.raises(InputError, match="gradient"):
            run_training(training, lambda: None, stopping=stopping)
        assert torch.get_deterministic_debug_mode() == before and memory.fill_uninitialized_memory
    finally:
        torch.set_deterministic_debug_mode(0)
    assert seen == [(max(before, 1), False)] * 2

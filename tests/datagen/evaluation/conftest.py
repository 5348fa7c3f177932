"""A small benchmark on the built-in world, planned, and checkpoints of tiny models that learned nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from datagen import cli
from datagen.evaluation.benchmark import Benchmark, BenchmarkRun, digests_of
from datagen.schemas.run import Run
from datagen.train.models import build_model
from datagen.train.training.checkpoints import Checkpoint, CheckpointHead, write_checkpoint
from tests.small_runs import GRID_CONFIG, OPEN_TOPS
from tests.train.training.small import TINY

SIDE = 5
SIZES = {"test": 32, "grids": 6 * SIDE * SIDE}


@pytest.fixture(scope="session")
def small_benchmark(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the runs and of their definition, benchmark.json. Tests only read it."""
    folder = tmp_path_factory.mktemp("benchmark")
    (folder / "small.toml").write_text(GRID_CONFIG.format(side=SIDE) + OPEN_TOPS)
    kinds = {"test": ["--candidates", "in-range", "--candidates-per-scene", "4"], "grids": ["--draws", "3"]}
    runs: dict[str, BenchmarkRun] = {}
    for seed, (name, kind) in enumerate(kinds.items()):
        out = folder / "runs" / name
        where = ["--config", str(folder / "small.toml"), "--out", str(out), "--workers", "0"]
        drawn = ["--n", str(SIZES[name]), "--seed", str(seed), "--split", "test"]
        assert cli.run(["submit", "plan", *drawn, *kind, *where]) == 0
        runs[name] = BenchmarkRun(
            about=f"small {name}",
            objects="all",
            n=SIZES[name],
            spec=Run.open(out).manifest.spec,
            digests=digests_of(out),
        )
    text = Benchmark(version="small", runs=runs).model_dump_json(indent=1)
    (folder / "runs" / "benchmark.json").write_text(text)
    return folder / "runs"


def checkpoint(path: Path, stage: str = "stage2", seed: int = 0, **said: Any) -> str:
    """A file with random weights and with what its document says; its name."""
    torch.manual_seed(seed)
    model = build_model("shared", TINY)
    plain: dict[str, Any] = {
        "options": {}, "data": (), "val_data": (), "house_ids": ("elsewhere",), "object_digests": (),
        "val_house_ids": (), "cost": {}, "versions": {}, "history": (),
    }  # fmt: skip
    head = CheckpointHead(model="shared", model_config=model.config, stage=stage, **{**plain, **said})
    write_checkpoint(path, Checkpoint(head, dict(model.state_dict())))
    return str(path)

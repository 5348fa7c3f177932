"""A small benchmark on the built-in world: sampled candidates and whole grids, planned."""

from __future__ import annotations

from pathlib import Path

import pytest

from datagen import cli
from datagen.evaluation.benchmark import Benchmark, BenchmarkRun, digests_of
from datagen.schemas.run import Run
from tests.small_runs import GRID_CONFIG

SIDE = 5
SIZES = {"test": 32, "grids": 6 * SIDE * SIDE}


@pytest.fixture(scope="session")
def small_benchmark(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the runs and of their definition, benchmark.json. Tests only read it."""
    folder = tmp_path_factory.mktemp("benchmark")
    (folder / "small.toml").write_text(GRID_CONFIG.format(side=SIDE))
    kinds = {"test": ["--candidates", "in-range", "--candidates-per-scene", "4"], "grids": []}
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

"""Time to label a run by another rule, and the space that it adds on disk, as a table.

    python -m benchmarks.relabel [--samples 180000] [--points 64] [--folder FOLDER]

Rows are random; shards, files and samples have the number and size of a real run with --samples labels.
Clouds are copied: with --points 4096 the bytes are those of a real run.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from datagen.jobs.relabelling import relabel_run, relabelled_specification
from datagen.schemas.run import Run
from datagen.schemas.sealing import seal
from datagen.schemas.storage import open_storage
from datagen.workers.labels import load_label_source
from tests.made_runs import make_run, small_spec

SCENES_PER_SHARD, PER_SCENE = 32, 60


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--samples", type=int, default=180_000)
    parser.add_argument("--points", type=int, default=64)
    parser.add_argument("--folder", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        engines = {"labels": str(load_label_source("heuristic").version)}
        spec = small_spec(n_points=options.points, engines=engines)
        source = make_run(Path(folder) / "run", options.samples, SCENES_PER_SHARD, PER_SCENE, spec=spec)
        seal(source.storage)
        print(f"{options.samples:,} labels in {len(source.committed())} shards")
        wall, cpu = time.perf_counter(), time.process_time()
        again = relabelled_specification(source, {"heuristic.mu": 0.6})
        done = relabel_run(open_storage(Path(folder) / "again"), source, again)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        assert done.remaining == 0
        _print(Run.open(done.path), options.samples, wall, cpu)


def _print(run: Run, samples: int, wall_s: float, cpu_s: float) -> None:
    written = sum(commit.cost.written_bytes for commit in run.commits())
    stages: dict[str, float] = {}
    for commit in run.commits():
        for stage, seconds in commit.cost.stage_cpu_s.items():
            stages[stage] = stages.get(stage, 0.0) + seconds
    print(f"{'relabelled and sealed':<24} {wall_s:>8.1f} s wall, {cpu_s:.1f} s CPU")
    print(f"{'labels/s':<24} {samples / wall_s:>8,.0f}")
    for stage, name in (("draw", "read"), ("visibility", "label"), ("write", "write")):
        print(f"{f'  {name}':<24} {stages.get(stage, 0.0):>8.1f} s CPU")
    print(f"{'written a label':<24} {written / samples:>8.1f} bytes")


if __name__ == "__main__":
    main()

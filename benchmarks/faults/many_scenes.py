"""Resident memory over a run of many small scenes, and over an epoch of reading it: is it flat?

python -m benchmarks.faults.many_scenes [--scenes 2000] [--workers 2] [--keep FOLDER]

Scenes are the cheapest that the built-in houses give. Memory is a process's own (resident less shared). The
first tenth is start-up; after it, the median of the last sixth may lie above that of the sixth before the
middle by 5 %, or by 20 MB where that is more. Exit code 1 where a process grew by more.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import psutil

from datagen.schemas.run import Run

CONFIG = """
[observation]
n_points = 128
width_px = 80
height_px = 60
fx_px = 77.0
fy_px = 77.0
min_target_points = 4
n_farthest = 32

[visibility]
window_px = 16

[scene]
n_clutter = 0
"""
PER_SCENE = 2
_READ = """
import json, sys
import psutil
from datagen.train.dataset import SampleStream
stream = SampleStream([sys.argv[1]], scenes_per_batch=4, buffer_shards=2)
samples, scenes, seen = [], 0, psutil.Process()
for batch in stream.epoch(0):
    scenes += len(batch.clouds)
    told = seen.memory_info()
    samples.append((scenes / stream.n_scenes, told.rss - told.shared))
print(json.dumps(samples))
"""
Samples = list[tuple[float, int]]  # (share of the work that is done, bytes)


def own_bytes(process: psutil.Process) -> int:
    """Resident bytes that the process shares with no other; 0 where it has ended."""
    try:
        memory = process.memory_info()
        return memory.rss - memory.shared
    except psutil.Error:
        return 0


def watched(command: Sequence[str], path: Path) -> dict[str, Samples]:
    """Memory of the driver and of its largest worker while the command makes a run of N shards."""
    samples: dict[str, Samples] = {"driver": [], "worker": []}
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as job:
        driver = psutil.Process(job.pid)
        while job.poll() is None:
            run = Run.open(path) if (path / "plans/1.json").exists() else None
            done = len(run.committed()) / len(run.planned()) if run else 0.0
            samples["driver"].append((done, own_bytes(driver)))
            workers = [p for p in driver.children(recursive=True) if p.name().startswith("ray::")]
            if workers:
                samples["worker"].append((done, max(map(own_bytes, workers))))
            time.sleep(0.5)
    if job.returncode:
        sys.exit(f"the run ended with {job.returncode}")
    return samples


def growth(samples: Samples) -> tuple[float, float, bool]:
    """MiB before the middle and at the end, and whether that is flat."""
    before, after = (
        statistics.median([size for done, size in samples if low <= done < high]) / 2**20
        for low, high in ((1 / 3, 1 / 2), (5 / 6, 1.0))
    )
    return before, after, after - before <= max(0.05 * before, 20e6 / 2**20)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--scenes", type=int, default=2000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--keep", type=Path, help="make the run here and keep it")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.keep or Path(scratch)
        (folder / "config.toml").write_text(CONFIG)
        words = [
            "--n",
            options.scenes * PER_SCENE,
            "--candidates-per-scene",
            PER_SCENE,
            "--out",
            folder / "run",
        ]
        words += ["--config", folder / "config.toml", "--workers", options.workers]
        command = [sys.executable, "-m", "datagen.cli", "submit", "heuristic", *map(str, words)]
        start_s = time.perf_counter()
        samples = watched(command, folder / "run")
        print(f"{options.scenes:,} scenes in {time.perf_counter() - start_s:.0f} s")
        start_s = time.perf_counter()
        reading = [sys.executable, "-c", _READ, str(folder / "run")]
        output = subprocess.run(reading, check=True, capture_output=True, text=True).stdout
        samples["reader"] = json.loads(output)
        print(f"an epoch of reading in {time.perf_counter() - start_s:.0f} s")
    good = True
    print(f"{'process':8} {'before the middle':>18} {'at the end':>12}")
    for name, some in samples.items():
        if some:
            before, after, flat = growth(some)
            good &= flat
            print(f"{name:8} {before:>14.1f} MiB {after:>8.1f} MiB  {'flat' if flat else 'GREW'}")
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()

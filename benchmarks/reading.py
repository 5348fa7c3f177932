"""How fast samples with their clouds are read: the stream, tensorstore and zarr-python, as a table.

    python -m benchmarks.reading [--samples 60000] [--run RUN]

Without a run it makes one of random rows (4,096 points a scene, the worst case for size) in a
temporary folder. `chunks`: the project's reader of chunks, which gives the same arrays as tensorstore and
zarr-python do. `stream`: batches for training, in one process with its thread. By whole shard: all samples
in stored order. Random: single samples drawn uniformly, each with its scene's cloud. Samples per second of
wall time are listed with samples per second of CPU time, which other programs on the machine disturb less.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from datagen.schemas.run import Run
from datagen.schemas.sealing import SEALED, seal
from datagen.train.batching import SAMPLE_FIELDS as SAMPLES
from datagen.train.batching import SCENE_FIELDS as SCENES
from datagen.train.dataset import SampleStream
from datagen.train.reader import load_shard
from datagen.train.run_parts import open_parts
from tests.train.stream_runs import make_stream_run

REPEATS = 5
FIELDS = (*SCENES, *SAMPLES, "sample_scene_index")
STREAMED = (*FIELDS, "scene_index")
TRAINED_A_SECOND = 4000  # docs/guides/read-data.md


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--samples", type=int, default=60_000)
    parser.add_argument("--scenes-per-shard", type=int, default=20)
    parser.add_argument("--run", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if options.run is None:
            started = time.perf_counter()
            run = make_stream_run(
                Path(folder) / "run",
                options.samples,
                scenes_per_shard=options.scenes_per_shard,
                candidates_per_scene=60,
                robots=4,
                cloud_points=4096,
            )
            print(f"made {run.n} samples in {time.perf_counter() - started:.1f} s")
        else:
            run = Run.open(options.run)
        started = time.perf_counter()
        seal(run.storage)
        print(f"sealed {len(run.committed())} shards in {time.perf_counter() - started:.2f} s")
        _print_sizes(run)
        _print_digests(Path(run.storage.url))
        _print_rates(Path(run.storage.url))


def _print_sizes(run: Run) -> None:
    paths = list((Path(run.storage.url) / "shards").rglob("*"))
    size = sum(p.stat().st_size for p in paths if p.is_file())
    blocks = sum(p.stat().st_blocks * 512 for p in paths)
    print(f"{size / run.n:.0f} bytes a sample, {blocks / run.n:.0f} on disk with files' and folders' blocks")


def _print_digests(folder: Path) -> None:
    """Print the cost of checking every object that a stream reads against its commit, once per process."""
    stream = SampleStream([folder])
    paths = sorted((folder / "shards").glob("*.zip"))
    spent: list[tuple[float, float]] = []
    for _ in range(REPEATS):
        begun = time.process_time()
        _ = sum(len(batch) for batch in stream.epoch(0))
        epoch_s, hash_s = time.process_time() - begun, 0.0
        for path in paths:
            data = path.read_bytes()
            begun = time.process_time()
            sha256(data).digest()
            hash_s += time.process_time() - begun
        spent.append((hash_s, epoch_s))
    hash_s, epoch_s = (statistics.median(column) for column in zip(*spent, strict=True))
    share = hash_s / (stream.n_samples / TRAINED_A_SECOND)
    print(f"sha256 of all objects, once in a process: {1000 * hash_s:.0f} CPU ms; of an epoch of reading")
    print(f"{hash_s / epoch_s:.1%}, of one of training at {TRAINED_A_SECOND:,} samples a second {share:.2%}")


def _print_rates(folder: Path) -> None:
    rows = [
        ("chunks", "committed shards", _rate(lambda: _chunks(folder))),
        ("chunks", "by whole shard", _rate(lambda: _chunks(folder / SEALED))),
        ("stream", "stored order", _rate(lambda: _stream(folder, shuffle=False))),
        ("stream", "shuffled, 8 shards", _rate(lambda: _stream(folder))),
        ("tensorstore", "by whole shard", _rate(lambda: _tensorstore_shards(folder))),
        ("tensorstore", "random, 64 in flight", _rate(lambda: _tensorstore_random(folder, 2000))),
        ("zarr-python", "by whole shard", _rate(lambda: _zarr_shards(folder))),
        ("zarr-python", "random", _rate(lambda: _zarr_random(folder, 100))),
    ]
    print(f"{'library':<12} {'order':<22} {'samples/s':>10} {'a CPU s':>10}")
    for library, order, (rate, cpu_rate) in rows:
        print(f"{library:<12} {order:<22} {rate:>10,.0f} {cpu_rate:>10,.0f}")


def _rate(work: Callable[[], int]) -> tuple[float, float]:
    """Samples a second of wall time and of CPU time, medians."""
    rates: list[tuple[float, float]] = []
    for _ in range(REPEATS):
        wall, cpu = time.perf_counter(), time.process_time()
        count = work()
        rates.append((count / (time.perf_counter() - wall), count / (time.process_time() - cpu)))
    return statistics.median(r[0] for r in rates), statistics.median(r[1] for r in rates)


def _chunks(path: Path) -> int:
    parts = open_parts([path], [*FIELDS, "scene_index"])
    return sum(len(load_shard(s, part.arrays)[0]["label"]) for part in parts for s in part.shards)


def _stream(folder: Path, **options: Any) -> int:
    """One epoch, with the time that opening the run takes."""
    return sum(len(b) for b in SampleStream([folder], **options).epoch(0))


def _spans(group: Any) -> tuple[int, list[tuple[int, int, int, int]]]:
    scenes, samples = group["scene_index"].shape[0], group["label"].shape[0]
    per_shard, per_scene = group.attrs["scenes_per_shard"], group.attrs["candidates_per_scene"]
    spans = [
        (s, min(s + per_shard, scenes), s * per_scene, min((s + per_shard) * per_scene, samples))
        for s in range(0, scenes, per_shard)
    ]
    return samples, spans


def _open_tensorstore(folder: Path) -> dict[str, Any]:
    import tensorstore as ts

    opened = {
        name: ts.open(
            {"driver": "zarr3", "kvstore": {"driver": "file", "path": f"{folder / SEALED / name}/"}},
            read=True,
        )
        for name in FIELDS
    }
    return {name: future.result() for name, future in opened.items()}


def _tensorstore_shards(folder: Path) -> int:
    arrays = _open_tensorstore(folder)
    samples, spans = _spans(zarr.open_group(folder / SEALED, mode="r"))
    for s0, s1, r0, r1 in spans:
        reads = [arrays[name][s0:s1] if name in SCENES else arrays[name][r0:r1] for name in FIELDS]
        for future in [a.read() for a in reads]:
            future.result()
    return samples


def _tensorstore_random(folder: Path, count: int) -> int:
    arrays = _open_tensorstore(folder)
    group = zarr.open_group(folder / SEALED, mode="r")
    rows = np.random.default_rng(0).integers(0, group["label"].shape[0], count)
    per_scene = group.attrs["candidates_per_scene"]
    for start in range(0, count, 64):
        futures = [
            arrays[name][int(row) // per_scene if name in SCENES else int(row)].read()
            for row in rows[start : start + 64]
            for name in FIELDS
        ]
        for future in futures:
            future.result()
    return count


def _zarr_shards(folder: Path) -> int:
    group = zarr.open_group(folder / SEALED, mode="r")
    arrays: dict[str, Any] = {name: group[name] for name in FIELDS}
    samples, spans = _spans(group)
    for s0, s1, r0, r1 in spans:
        for name in FIELDS:
            _ = arrays[name][s0:s1] if name in SCENES else arrays[name][r0:r1]
    return samples


def _zarr_random(folder: Path, count: int) -> int:
    group: Any = zarr.open_group(folder / SEALED, mode="r")
    arrays: dict[str, Any] = {name: group[name] for name in FIELDS}
    per_scene = group.attrs["candidates_per_scene"]
    for row in np.random.default_rng(0).integers(0, group["label"].shape[0], count):
        for name in FIELDS:
            _ = arrays[name][int(row) // per_scene if name in SCENES else int(row)]
    return count


if __name__ == "__main__":
    main()

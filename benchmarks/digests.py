"""Digests of labels and of every stored byte of fresh runs, to compare two versions of the program.

    python -m benchmarks.digests [--n 3000] [--assets DIR] [--checkout DIR] [--folder FOLDER]

Makes `n` labels of each source and prints, for each, the sha256 of all sample ids with their labels, and of
the paths and checksums of all files of all shards. Equal rows mean equal labels and equal bytes. `--checkout`
makes the runs with another checkout's code; this one reads what it stores.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import zarr

RUNS = {
    "heuristic": (),
    "plan": ("--candidates", "in-range", "--candidates-per-scene", "15"),
    "sim": ("--candidates", "in-range", "--candidates-per-scene", "15", "--perturb", "1"),
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--n", type=int, default=3000)
    parser.add_argument("--assets", type=Path, help="folder with procthor/ and ycb/ [built-in ones]")
    parser.add_argument("--checkout", type=Path, default=Path.cwd())
    parser.add_argument("--folder", type=Path)
    options = parser.parse_args()
    world: list[str] = []
    if options.assets is not None:
        world = ["--houses", f"procthor:{options.assets}/procthor", "--objects", f"ycb:{options.assets}/ycb"]
    print(f"{'source':<10} {'labels':>6} {'positive':>8}  {'ids and labels':<16}  {'stored bytes':<16}")
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        for source, more in RUNS.items():
            run = Path(folder) / source
            arguments = ["submit", source, "--n", str(options.n), "--out", str(run), *world, *more]
            subprocess.run(
                [sys.executable, "-m", "datagen.cli", *arguments],
                env={**os.environ, "PYTHONPATH": str(options.checkout.resolve())},
                cwd=options.checkout,
                check=True,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            n, positive, labels = digest_of_labels(run)
            stored = digest_of_bytes(run)
            print(f"{source:<10} {n:>6,} {positive:>8,}  {labels:<16}  {stored:<16}", flush=True)


def digest_of_labels(run: Path) -> tuple[int, int, str]:
    """Number of labels, of positive ones, and a digest of ids and labels, in the sealed store's order."""
    group = zarr.open_group(run / "data.zarr", mode="r")
    ids, labels = (np.ascontiguousarray(np.asarray(group[name])) for name in ("sample_id", "label"))
    digest = hashlib.sha256(ids.tobytes() + labels.tobytes()).hexdigest()
    return len(labels), int((labels == 1).sum()), digest[:16]


def digest_of_bytes(run: Path) -> str:
    """A digest of paths and checksums of all files of all shards."""
    digest = hashlib.sha256()
    for commit in sorted(run.glob("commits/*.json")):
        record = json.loads(commit.read_text())
        files = sorted((file["path"], file["sha256"]) for file in record["files"])
        digest.update(json.dumps([record["shard"], files]).encode())
    return digest.hexdigest()[:16]


if __name__ == "__main__":
    main()

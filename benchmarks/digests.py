"""Digests of labels and of every stored row of fresh runs, to compare two versions of the program.

    python -m benchmarks.digests [--n 3000] [--assets DIR] [--checkout DIR] [--folder FOLDER]

Makes `n` labels of each source and prints, for each, the sha256 of all sample ids with their labels, and of
all arrays of the sealed store, read by zarr alone. Targets stand on open tops. `--checkout` makes
the runs with another checkout's code, which must know `places = {}`.
"""

from __future__ import annotations

import argparse
import hashlib
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
    print(f"{'source':<10} {'labels':>6} {'positive':>8}  {'ids and labels':<16}  {'all arrays':<16}")
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        (tops := Path(folder) / "tops.toml").write_text("[scene]\nplaces = {}\n")
        for source, more in RUNS.items():
            run = Path(folder) / source
            arguments = ["submit", source, "--n", str(options.n), "--out", str(run), *world, *more]
            arguments += ["--config", str(tops.resolve())] if more else []
            subprocess.run(
                [sys.executable, "-m", "datagen.cli", *arguments],
                env={**os.environ, "PYTHONPATH": str(options.checkout.resolve())},
                cwd=options.checkout,
                check=True,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            n, positive, labels = digest_of_labels(run)
            stored = digest_of_rows(run)
            print(f"{source:<10} {n:>6,} {positive:>8,}  {labels:<16}  {stored:<16}", flush=True)


def digest_of_labels(run: Path) -> tuple[int, int, str]:
    """Number of labels, of positive ones, and a digest of ids and labels, in the sealed store's order."""
    group = zarr.open_group(run / "data.zarr", mode="r")
    ids, labels = (np.ascontiguousarray(np.asarray(group[name])) for name in ("sample_id", "label"))
    digest = hashlib.sha256(ids.tobytes() + labels.tobytes()).hexdigest()
    return len(labels), int((labels == 1).sum()), digest[:16]


def digest_of_rows(run: Path) -> str:
    """Digest over name, type, shape and values of every array of the sealed store."""
    group, digest = zarr.open_group(run / "data.zarr", mode="r"), hashlib.sha256()
    for name in sorted(group.array_keys()):
        values = np.asarray(group[name][...])
        text = values.dtype.kind in "OTU"
        data = "\0".join(values.astype(object).ravel().tolist()).encode() if text else values.tobytes()
        digest.update(f"{name} {'text' if text else values.dtype.str} {values.shape}".encode() + data)
    return digest.hexdigest()[:16]


if __name__ == "__main__":
    main()

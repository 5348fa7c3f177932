"""Power cuts on ext4 at random moments: is every committed shard there, and the run as if undisturbed?

    python -m benchmarks.faults.power_cut [--runs 8] [--cuts 4] [--shards 30] [--seed 0]

A job makes a run in three steps, each of which ends with a seal, on an ext4 image on a loop device. At a
random moment the file system is shut down without a flush of its journal, as by a power cut, and the job is
killed; then it is mounted again. After each cut, every shard and store that the job was told to be durable
must be there with its bytes, and `verify` may only miss records that a resume writes. After the last cut the
job is resumed: it completes, `verify` finds nothing, and all bytes are those of an undisturbed run. Anything
else raises AssertionError. Needs root and loop devices; without these it says so and ends with 0.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from datagen.schemas.sealing import seal
from tests.faults.counted import SAMPLES_PER_SHARD, memory_folder
from tests.faults.power_cut_campaign import Disk, check_cut, check_done, cut_one, mounted_disk, start
from tests.made_runs import make_run


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--cuts", type=int, default=4, help="of each run")
    parser.add_argument("--shards", type=int, default=30, help="of each run, a multiple of 3")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with ExitStack() as stack:
        try:
            disk = stack.enter_context(mounted_disk(Path(stack.enter_context(tempfile.TemporaryDirectory()))))
        except (OSError, subprocess.CalledProcessError) as error:
            said = str(getattr(error, "stderr", None) or error).strip()
            print(f"no power is cut: that needs root, mkfs.ext4 and loop devices ({said})")
            return
        counts, took_s = cut_all(
            disk,
            stack.enter_context(memory_folder()),
            options.runs,
            options.cuts,
            options.shards,
            options.seed,
        )
    print(f"nothing durable is lost, and every run as the undisturbed one; a job takes {took_s:.1f} s")
    for name, value in counts.items():
        print(f"{name:32} {value:>10,}")


def cut_all(
    disk: Disk, work: Path, runs: int, cuts: int, shards: int, seed: int
) -> tuple[Counter[str], float]:
    """Cut the power N times in each run; the counts, and the seconds of an undisturbed job."""
    rng, noted = np.random.default_rng(seed), work / "noted"
    whole = make_run(work / "whole", shards * SAMPLES_PER_SHARD)
    seal(whole.storage)
    counts, took_s = Counter({"runs": runs}), 0.0
    for number in range(runs + 1):
        folder = disk.folder / f"run-{number}"
        noted.write_text("")
        for _ in range(cuts if number else 0):  # the first run says how long a job takes
            cut_one(disk, folder, noted, shards, float(rng.uniform(0, took_s)))
            check_cut(folder, noted, counts)
        process, start_s = start(folder, noted, shards), time.monotonic()
        process.join()
        took_s = took_s or time.monotonic() - start_s
        assert process.exitcode == 0, "the resumed job does not complete"
        check_done(folder, whole)
    return counts, took_s


if __name__ == "__main__":
    main()

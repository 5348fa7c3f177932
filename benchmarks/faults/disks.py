"""A run on a file system whose quota is spent again and again, and one on a file system that stalls.

    python -m benchmarks.faults.disks [--shards 60] [--step-kib 40] [--stall 100]

The quota is that of a btrfs subvolume; ext4 is frozen for `--stall` seconds while two Ray workers commit,
longer than their deadline of 60 s. Each must end with the bytes of an undisturbed run; anything else raises
AssertionError. Needs root, loop devices, fsfreeze and btrfs-progs; without these it says so and ends with 0.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from pathlib import Path

from datagen.schemas.sealing import seal
from tests.faults.counted import SAMPLES_PER_SHARD
from tests.faults.disk_campaign import fill_quota, quota_folder, stall_disk
from tests.faults.power_cut_campaign import mounted_disk
from tests.made_runs import make_run


def main() -> None:
    """Print a line for each file system."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--shards", type=int, default=60, help="of each run, a multiple of 3")
    parser.add_argument("--step-kib", type=int, default=40, help="by which the quota is raised")
    parser.add_argument("--stall", type=float, default=100.0, help="seconds")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for name in ("quota", "stall", "whole"):
            (Path(folder) / name).mkdir()
        whole = make_run(Path(folder) / "whole/run", options.shards * SAMPLES_PER_SHARD)
        seal(whole.storage)
        try:
            with quota_folder(Path(folder) / "quota") as (limited, limit):
                refused = fill_quota(limited, limit, whole, options.shards, options.step_kib)
                print(f"quota: spent {refused} times in {options.shards} shards", flush=True)
            with mounted_disk(Path(folder) / "stall") as disk:
                ended = stall_disk(disk.folder, options.shards, options.stall)
                print(f"stall of {options.stall:g} s: attempts {ended}")
        except (OSError, subprocess.CalledProcessError) as error:
            print(f"not tried: {str(getattr(error, 'stderr', None) or error).strip()}")
            return
    print("both runs as the undisturbed one")


if __name__ == "__main__":
    main()

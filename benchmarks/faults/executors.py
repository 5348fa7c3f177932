"""Random kill -9 of the raylets and GCS servers of local Ray clusters: is the run the undisturbed one?

python -m benchmarks.faults.executors [--kills 4] [--runs 1] [--shards 12] [--seconds 0.5] [--seed 0]

Each run is made on a cluster of two slots, one of whose servers is killed `--kills` times. Its job completes,
or ends and is resumed; the sealed bytes are those of an undisturbed run, no shard is quarantined, and the
ledger holds the commits and the waste, and nothing else. Anything else raises AssertionError.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from tests.faults.counted import memory_folder
from tests.faults.server_campaign import kill_servers


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--kills", type=int, default=4, help="of one server in one run")
    parser.add_argument("--runs", type=int, default=1, help="for each of the two servers")
    parser.add_argument("--shards", type=int, default=12)
    parser.add_argument("--seconds", type=float, default=0.5, help="duration of a shard")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    heads = ("kills", "jobs aborted", "shards", "attempts wasted")
    print("  ".join(f"{head:>15}" for head in ("killed", *heads, "seconds")))
    for kind in ("raylet", "gcs_server") * options.runs:
        with memory_folder() as folder:
            start_s = time.monotonic()
            seen = kill_servers(folder, kind, options.kills, options.shards, options.seconds, rng)
            row = (kind, *(seen[head] for head in heads), round(time.monotonic() - start_s))
        print("  ".join(f"{value:>15}" for value in row), flush=True)
    print("every run is the undisturbed one, byte by byte; no shard quarantined; ledger = commits + waste")


if __name__ == "__main__":
    main()

"""Two jobs, each with a Ray cluster of its own, on one run of an S3 server; then one of them is killed.

    python -m benchmarks.faults.two_clusters [--shards 60] [--seconds 0.3] [--delay 0.03]

After each pair, committed objects and the sealed store must be those of an undisturbed local run, and the
ledger must have each attempt once. Anything else raises AssertionError.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

from tests.faults.cluster_pair import run_pair
from tests.s3_servers import Faults, environment, faulty_proxy, make_bucket, moto_server


def main() -> None:
    """Print a row for each pair."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--shards", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=0.3, help="duration of a shard")
    parser.add_argument("--delay", type=float, default=0.03, help="seconds before each answer of the store")
    options = parser.parse_args()
    with (
        tempfile.TemporaryDirectory() as folder,
        moto_server(Path(folder) / "moto.log") as upstream,
        faulty_proxy(upstream, Faults(delay_s=options.delay)) as port,
    ):
        os.environ.update(environment(port))
        make_bucket(upstream, "clusters")
        for name, kill in (("both live", False), ("one is killed", True)):
            (below := Path(folder) / name).mkdir()
            address = f"s3://clusters/{below.name.replace(' ', '-')}"
            ended = run_pair(address, options.shards, options.seconds, below, kill)
            print(f"{name:14}", *(f"{outcome} {count:,}" for outcome, count in ended.items()), flush=True)
    print("nothing lost, nothing doubled, every attempt in the ledger")


if __name__ == "__main__":
    main()

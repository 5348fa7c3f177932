"""Two drivers on one run: one winner a shard, and the share of time that the losers waste.

python -m benchmarks.faults.two_drivers [--shards 1000] [--seconds 0.1] [--workers 2] [--drivers 2]
"""

from __future__ import annotations

import argparse

from tests.faults.counted import memory_folder
from tests.faults.driver_pair import drive_in_pairs


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--shards", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=0.1, help="duration of a shard")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--drivers", type=int, default=2)
    options = parser.parse_args()
    counts: list[dict[str, float]] = []
    for stubborn in (True, False):
        with memory_folder() as folder:
            counts.append(
                drive_in_pairs(
                    folder, options.shards, options.seconds, options.workers, stubborn, options.drivers
                )
            )
    print("one winner a shard, every byte as committed, ledger = commits + waste in both")
    print(f"{'':32} {'ignoring':>12} {'yielding':>12}")
    for name in dict.fromkeys([*counts[0], *counts[1]]):
        values = [
            f"{row.get(name, 0):>12.3f}" if "share" in name else f"{row.get(name, 0):>12,}" for row in counts
        ]
        print(f"{name:32} {' '.join(values)}")


if __name__ == "__main__":
    main()

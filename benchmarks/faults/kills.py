"""Random kill -9 of workers and drivers: is the run as if undisturbed, with every attempt in the ledger?

python -m benchmarks.faults.kills [--worker-kills 200] [--driver-kills 50] [--shards 600] [--workers 3]
"""

from __future__ import annotations

import argparse

from tests.faults.counted import memory_folder
from tests.faults.kill_campaign import kill_at_random


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--worker-kills", type=int, default=200)
    parser.add_argument("--driver-kills", type=int, default=50)
    parser.add_argument("--shards", type=int, default=600)
    parser.add_argument("--seconds", type=float, default=0.1, help="duration of a shard")
    parser.add_argument("--workers", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with memory_folder() as folder:
        counts = kill_at_random(
            folder,
            options.worker_kills,
            options.driver_kills,
            options.shards,
            options.seconds,
            options.workers,
            options.seed,
        )
    print("the sealed store equals an uninterrupted run's; executions, ledger, commits and audit agree")
    for name, value in counts.items():
        print(f"{name:32} {value:>10.3f}" if isinstance(value, float) else f"{name:32} {value:>10,}")


if __name__ == "__main__":
    main()

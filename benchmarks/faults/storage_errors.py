"""One system call of a real program fails with EIO, ENOSPC or EDQUOT, in attempts, seals, merges and repairs.

    python -m benchmarks.faults.storage_errors [--sample 12] [--only seal]

Each failure must end in success or in one line of error and the documented exit code; the same command again
must give the result of an undisturbed one, without damage. `refused` counts those that ended with an error.
Needs strace.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from tests.faults.storage_errors_campaign import OPERATIONS, can_trace, try_errors


def main() -> None:
    """Print the table; ends with 1 where a promise was broken."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--sample", type=int, default=12, help="calls of each operation")
    options.add_argument("--only", action="append", choices=[operation.name for operation in OPERATIONS])
    options.add_argument("--seed", type=int, default=0)
    chosen = options.parse_args()
    if not can_trace():
        raise SystemExit("strace is not here, or may not trace: install it, or allow ptrace")
    rng, wrong, began_s = np.random.default_rng(chosen.seed), list[str](), time.perf_counter()
    print(f"{'operation':<12}{'tried':>8}{'refused':>9}{'wrong':>7}")
    with tempfile.TemporaryDirectory() as folder:
        for operation in OPERATIONS:
            if chosen.only and operation.name not in chosen.only:
                continue
            found = try_errors(operation, Path(folder), chosen.sample, rng)
            print(f"{operation.name:<12}{found.tried:>8}{found.refused:>9}{len(found.wrong):>7}", flush=True)
            wrong += found.wrong
    print(f"{time.perf_counter() - began_s:.0f} s")
    for line in wrong[:50]:
        print(line)
    if wrong:
        raise SystemExit(1)


if __name__ == "__main__":
    main()

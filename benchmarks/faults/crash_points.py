"""A kill, a failing disk and a full one at every call by which operations change a run, as a table.

    python -m benchmarks.faults.crash_points [--only seal --only clean] [--sample 20]

Points are: a kill before each call that changes a file, a kill after half the bytes of each write, an
input/output error of each call, and a disk that is full from each call on. After each, a fresh process
checks the run, continues as a user would, and checks again. `absent`: points after which every unit is as
before the operation; `there`: as after it; `between`: some units of several as after it; `refused`: points
that ended in an error of one line. Violations: points after which a unit is neither.
"""

from __future__ import annotations

import argparse
import sys

from tests.faults.crash_points_campaign import run_campaign
from tests.faults.crash_points_operations import OPERATIONS


def main() -> int:
    """Print the table; 1 where anything was violated."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--only", action="append", choices=[operation.name for operation in OPERATIONS])
    parser.add_argument("--sample", type=int, help="points of each kind, in place of all")
    options = parser.parse_args()
    heads = ("calls", "points", "absent", "there", "between", "refused")
    print(f"{'operation':<16}" + "".join(f"{head:>9}" for head in heads) + f"{'violations':>12}")
    violations: list[str] = []
    sums = dict.fromkeys(heads, 0)
    for name in options.only or [operation.name for operation in OPERATIONS]:
        (found,) = run_campaign([name], options.sample)
        for head in heads:
            sums[head] += getattr(found, head)
        print(
            f"{found.operation:<16}"
            + "".join(f"{getattr(found, head):>9,}" for head in heads)
            + f"{len(found.violations):>12,}",
            flush=True,
        )
        violations += [f"{found.operation}: {violation}" for violation in found.violations]
    print(f"{'all':<16}" + "".join(f"{sums[head]:>9,}" for head in heads) + f"{len(violations):>12,}")
    for violation in violations[:50]:
        print(violation)
    return 1 if violations else 0


if __name__ == "__main__":
    sys.exit(main())

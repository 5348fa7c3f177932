"""Random histories of commits, crashes, resumes, merges and repairs: does each run match a dictionary?

python -m benchmarks.faults.histories [--examples 200] [--steps 50]
"""

from __future__ import annotations

import argparse
import time

from hypothesis.stateful import run_state_machine_as_test

from tests.properties.test_state_machine import AnyHistory, many_histories


def main() -> None:
    """Print how many histories were tried; raises AssertionError for the shortest that breaks a promise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--examples", type=int, default=200)
    parser.add_argument("--steps", type=int, default=50, help="at most, of one history")
    options = parser.parse_args()
    start_s = time.monotonic()
    run_state_machine_as_test(AnyHistory, settings=many_histories(options.examples, options.steps))
    print(
        f"{options.examples:,} histories of at most {options.steps} steps, {time.monotonic() - start_s:.0f} s"
    )


if __name__ == "__main__":
    main()

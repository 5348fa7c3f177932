"""Whole files that exchange their names: swaps that checks miss, and bytes that repair gets wrong or loses.

    python -m benchmarks.faults.swaps [--each 30]

Two files of one sort exchange their names: records and their copies, and chunks of equal size; within a
run, between the parts of a merged run, and between a sealed run, one that is not sealed and a merged
run. After each swap the runs are checked, repaired and checked again. `restored`: every byte is as
before. `set aside`: so are the rows, after a resume. `left`: checks still find something, and only the two
files differ. Anything else is wrong.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

from tests.faults.damage_campaign import fewer_arrays, findings_at
from tests.faults.swap_campaign import PLACES, Swaps, make_world, swaps, try_swap


def main() -> None:
    """Print the table; ends with 1 where a promise was broken."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--each", type=int, default=30, help="pairs of each sort; 0 takes all")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument(
        "--folder", type=Path, help="where the runs are made [the system's temporary folder]"
    )
    chosen = options.parse_args()
    with fewer_arrays(), tempfile.TemporaryDirectory(dir=chosen.folder) as folder:
        clean, found, began_s = Path(folder) / "clean", Swaps(), time.perf_counter()
        make_world(clean)
        if any(findings_at(clean / name) for name in PLACES):
            raise SystemExit("the sound runs have findings")
        for swap in swaps(clean, chosen.each or None, np.random.default_rng(chosen.seed)):
            try_swap(clean, Path(folder) / "world", swap, found)
    print(f"{'swapped':<26}{'tried':>10}{'restored':>10}{'set aside':>10}{'left':>10}")
    sums = Counter({"tried": 0})
    for kind in sorted(found.tried):
        each = {
            "tried": found.tried,
            "restored": found.restored,
            "set aside": found.set_aside,
            "left": found.left,
        }
        counts = {name: of[kind] for name, of in each.items()}
        print(f"{kind:<26}" + "".join(f"{count:>10}" for count in counts.values()))
        sums.update(counts)
    print(f"{'all':<26}" + "".join(f"{count:>10}" for count in sums.values()))
    print(f"{len(found.wrong)} wrong; {time.perf_counter() - began_s:.0f} s")
    for wrong in found.wrong[:50]:
        print(wrong)
    if found.wrong:
        raise SystemExit(1)


if __name__ == "__main__":
    main()

"""Damage of every kind to a run: damage that checks miss, and bytes that repair and resume do not restore.

    python -m benchmarks.faults.damage [--flips 1000] [--cuts-every 1] [--repair-every 1]

Random single bit flips over every sort of file, and each file in turn removed, cut and grown; each damage is
checked, repaired, resumed and checked again, and the run is then compared with the original, byte by byte.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from tests.faults.damage_campaign import (
    Campaign,
    cuts,
    fewer_arrays,
    findings_at,
    flips,
    keys_of,
    make_place,
    try_all,
)


def main() -> None:
    """Print the table; ends with 1 where anything was missed or not restored."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--flips", type=int, default=1000)
    options.add_argument("--cuts-every", type=int, default=1, help="take each N-th removal and cut only")
    options.add_argument("--repair-every", type=int, default=1, help="repair each N-th damage only")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--folder", type=Path, help="where the run is made [the system's temporary folder]")
    chosen = options.parse_args()
    with fewer_arrays(), tempfile.TemporaryDirectory(dir=chosen.folder) as folder:
        clean = Path(folder) / "clean"
        make_place(clean, n=9, scenes_per_shard=1)
        if findings_at(clean):
            raise SystemExit("the sound run has findings")
        files, campaign, began_s = len(keys_of(clean)), Campaign(), time.perf_counter()
        rng = np.random.default_rng(chosen.seed)
        scratch = Path(folder) / "run"
        try_all(clean, scratch, flips(clean, chosen.flips, rng), campaign, chosen.repair_every)
        cut = [damage for i, damage in enumerate(cuts(clean)) if i % chosen.cuts_every == 0]
        try_all(clean, scratch, cut, campaign, chosen.repair_every)
        elapsed_s = time.perf_counter() - began_s
    heads = ("damage", "tried", "missed", "repaired", "not restored", "not clean")
    rows = [heads, *((row[0], *map(str, row[1:])) for row in campaign.rows())]
    total = [sum(int(row[k]) for row in rows[1:]) for k in range(1, len(heads))]
    rows.append(("all", *map(str, total)))
    for row in rows:
        print("".join(f"{cell:>14}" if k else f"{cell:<26}" for k, cell in enumerate(row)))
    print(f"{files} files; {elapsed_s:.0f} s")
    for bad in (*campaign.missed, *campaign.not_restored, *campaign.not_clean)[:20]:
        print(bad)
    if total[1] or total[3] or total[4]:
        raise SystemExit(1)


if __name__ == "__main__":
    main()

"""The effect of execution: the same candidates planned, executed as planned, and in disturbed worlds.

    datagen submit sim --n 300 --candidates in-range --candidates-per-scene 15 ... --out CALM
    datagen submit sim --n 300 --scenes-from CALM --perturb 5 --out DISTURBED
    python -m benchmarks.disturbed CALM DISTURBED

Prints successes, labels that change, the entropy of the label among planned candidates, how the
success rate depends on the grasp's score and on distance over reach, and the causes of failure.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from datagen.schemas.fields import OUTCOMES
from datagen.schemas.sealing import SEALED
from datagen.workers.geometry.mesh import F64

_NAMES = tuple(OUTCOMES)
COLUMNS = (
    "sample_scene_index",
    "candidate_index",
    "outcome",
    "trials",
    "successes",
    "grasp_score",
    "mount_distance_m",
    "arm_reach_m",
)
SCORE_EDGES = (0.0, 0.5, 0.7, 1.0, 1.01)
SHARE_EDGES = (0.0, 0.6, 0.7, 0.8, 0.9, 1.0)

Columns = dict[str, np.ndarray[Any, Any]]


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("calm", metavar="CALM", type=Path, help="a sealed run of sim without disturbance")
    parser.add_argument("disturbed", metavar="DISTURBED", type=Path, help="the same candidates, disturbed")
    options = parser.parse_args()
    calm, disturbed = columns_of(options.calm), columns_of(options.disturbed)
    shared = min(len(calm["outcome"]), len(disturbed["outcome"]))  # one run may be longer
    calm, disturbed = ({name: v[:shared] for name, v in run.items()} for run in (calm, disturbed))
    for name in ("sample_scene_index", "candidate_index"):
        if not np.array_equal(calm[name], disturbed[name]):
            parser.error("the runs do not hold the same candidates: make one with --scenes-from the other")
    planned = disturbed["trials"] > 0
    good, still_good = calm["outcome"] == 0, disturbed["outcome"] == 0
    rate = disturbed["successes"] / np.maximum(disturbed["trials"], 1)
    print(f"{len(good)} candidates, {planned.sum()} planned")
    print(f"{'of the planned':34}{'calm':>9}{'disturbed':>11}")
    print(f"{'label 1':34}{100 * good[planned].mean():8.1f}%{100 * still_good[planned].mean():10.1f}%")
    print(
        f"{'entropy of the label, bits':34}{entropy(good[planned]):9.2f}{entropy(still_good[planned]):11.2f}"
    )
    print(f"{'executions that succeed':34}{'':9}{100 * rate[planned].mean():10.1f}%")
    mixed = planned & (rate > 0) & (rate < 1)
    print(f"labels that change: {100 * (good != still_good)[planned].mean():.1f}%")
    print(f"some repeats succeed and some do not: {100 * mixed.sum() / planned.sum():.1f}%")
    counts = np.bincount(disturbed["successes"][planned])
    print("successes among the repeats: " + ", ".join(f"{k}: {n}" for k, n in enumerate(counts)))
    print(f"variance of these over chance's alone: {over_chance(disturbed, planned):.2f}")
    print_rate("grasp's score", disturbed["grasp_score"][planned], rate[planned], SCORE_EDGES)
    share = (disturbed["mount_distance_m"] / disturbed["arm_reach_m"])[planned]
    print_rate("distance / reach", share, rate[planned], SHARE_EDGES)
    print("\nlabel 0, by cause, of the planned")
    for name, columns in (("calm", calm), ("disturbed", disturbed)):
        ends = Counter(_NAMES[code] for code in columns["outcome"][planned] if code)
        print(f"{name:12}" + (", ".join(f"{cause} {n}" for cause, n in ends.most_common()) or "none"))


def columns_of(run: Path) -> Columns:
    """Columns of a run that the tables need, (N,) each."""
    store = zarr.open_group(str(run / SEALED), mode="r")
    return {name: np.asarray(store[name]) for name in COLUMNS}


def entropy(good: np.ndarray[Any, Any]) -> float:
    """Bits that one label carries: 1 where half are good, 0 where all are alike."""
    share = float(good.mean())
    return float(sum(-p * np.log2(p) for p in (share, 1 - share) if p > 0))


def over_chance(disturbed: Columns, planned: np.ndarray[Any, Any]) -> float:
    """Variance of successes among the repeats over that of a binomial with one rate for all.

    1 where all candidates have one rate, and up to the number of repeats where the candidate alone decides.
    """
    successes, repeats = disturbed["successes"][planned], int(disturbed["trials"].max())
    rate = float(successes.mean()) / repeats
    return float(successes.var(ddof=1)) / (repeats * rate * (1 - rate))


def print_rate(name: str, values: np.ndarray[Any, Any], rate: F64, edges: Sequence[float]) -> None:
    """Mean success rate of planned candidates by band [low, high)."""
    print(f"\n{name:18}{'planned':>9}{'success rate':>14}")
    for low, high in pairwise(edges):
        rows = (values >= low) & (values < high)
        if rows.any():
            print(f"{f'{low:g} to {min(high, 1.0):g}':18}{rows.sum():9}{100 * rate[rows].mean():13.1f}%")


if __name__ == "__main__":
    main()

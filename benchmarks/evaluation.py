"""Time and memory of tables and intervals over scored candidates, as a table.

    python -m benchmarks.evaluation [--scenes 1000] [--per-scene 625] [--methods 10] [--bootstrap 1000]

Scores and labels are random: only their number matters.
"""

from __future__ import annotations

import argparse
import resource
import time
from dataclasses import replace

import numpy as np

from datagen.evaluation.comparisons import Method
from datagen.evaluation.scores import evaluate_grids, evaluate_set, weights_for
from datagen.workers.bases.candidate_sets import CANDIDATE_SETS
from tests.datagen.evaluation.made_columns import make_columns


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--scenes", type=int, default=1000)
    parser.add_argument("--per-scene", type=int, default=625)
    parser.add_argument("--methods", type=int, default=10)
    parser.add_argument("--bootstrap", type=int, default=1000)
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    columns = make_columns(rng, options.scenes, options.per_scene, {})
    names = [f"method {k}" for k in range(options.methods)]
    columns = replace(columns, scores={name: rng.random(len(columns)) for name in names})
    methods = [Method(name, 0.5) for name in names]
    print(f"{options.scenes:,} scenes of {options.per_scene}, {options.methods} methods")
    started_s = time.process_time()
    weights = weights_for(columns, options.bootstrap, 0)
    print(f"{options.bootstrap:,} resamples drawn: {time.process_time() - started_s:.2f} CPU s")
    for name in CANDIDATE_SETS:
        started_s = time.process_time()
        count = evaluate_set(columns, methods, name, weights)["count"]
        spent_s = time.process_time() - started_s
        print(f"Tables I and II, curves, breakdowns ({name}, {count:,} candidates): {spent_s:.1f} CPU s")
    started_s = time.process_time()
    evaluate_grids(columns, methods, weights)
    print(f"Table III: {time.process_time() - started_s:.1f} CPU s")
    print(f"peak memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000:.0f} MB")


if __name__ == "__main__":
    main()

"""The visibility estimated from a cloud, compared with the true one from rays through the whole scene.

python -m benchmarks.observed_visibility RUN...
"""

from __future__ import annotations

import sys
import time

import numpy as np

from datagen.schemas.specification import HeuristicParams
from datagen.train.baselines.baseline import mount_m, planar_distance_m, reach_m
from datagen.train.dataset import SampleStream
from datagen.train.observed_visibility import observed_visibility
from datagen.workers.labels.distance_visibility_score import heuristic


def main(paths: list[str]) -> None:
    """Print correlation, errors, the rule's agreement, and CPU time, run by run."""
    for path in paths:
        rho, found, labels, ruled, seconds = [], [], [], [], 0.0
        for batch in SampleStream([path], extra=("visibility",), shuffle=False).epoch(0):
            began = time.process_time()
            estimate = observed_visibility(batch.clouds, batch.robots, batch.candidates)
            seconds += time.process_time() - began
            true = batch.extra["visibility"]
            d = [f(batch).astype(np.float32) for f in (planar_distance_m, mount_m, reach_m)]
            labels.append(heuristic(d[0], d[1], d[2], true, HeuristicParams())[1])
            ruled.append(heuristic(d[0], d[1], d[2], estimate.astype(np.float32), HeuristicParams())[1])
            rho.append(true)
            found.append(estimate)
        true, estimate = np.concatenate(rho), np.concatenate(found)
        label, predicted = np.concatenate(labels) == 1, np.concatenate(ruled) == 1
        print(f"{path}: {len(true):,} candidates, {1e3 * seconds / len(true):.2f} CPU ms each")
        print(f"  correlation with rho         {np.corrcoef(true, estimate)[0, 1]:.3f}")
        print(f"  mean absolute error          {np.abs(estimate - true).mean():.3f}")
        print(f"  mean error                   {(estimate - true).mean():+.3f}")
        print(f"  accuracy of the rule         {(predicted == label).mean():.3f}")
        balanced = (predicted[label].mean() + (~predicted)[~label].mean()) / 2
        print(f"  balanced accuracy            {balanced:.3f}")


if __name__ == "__main__":
    main(sys.argv[1:])

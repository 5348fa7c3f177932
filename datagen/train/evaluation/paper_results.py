"""The paper's numbers, for comparison.

GBPP: Grasp-Aware Base Placement Prediction for Robots via Two-Stage Learning, arXiv:2509.11594, Tables
I to III and their text. They are for other candidates, houses and arms, and not directly comparable.
"""

from __future__ import annotations

from collections.abc import Mapping

SOURCE = "GBPP, arXiv:2509.11594"

# Accuracy on labels of simulation, by method: Table I, and the three regimes of training of Table II.
ACCURACY: Mapping[str, float] = {
    "proximity": 0.4691,
    "threshold": 0.5691,
    "threshold-detector": 0.6873,
    "stage1": 0.7675,
    "sim-only": 0.7911,
    "two-stage": 0.8413,
}
# Accuracy of its two-stage model where the target is beyond the arm's reach.
ACCURACY_OUT_OF_REACH = 0.9917
# Over whole grids (Table III): the share of good ones among the best candidates of its two-stage model, and
# the mean distance of the others from a good one.
GRID_SELECTION = 0.9466
GRID_MISS_M = 0.24
# Time for this number of candidates on the laptop version of an RTX 4090.
TIMED_CANDIDATES, TIMED_S = 600, 0.3

"""Choose a base pose: the best score, or the best expected success with an arrival error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from datagen.train.arrivals import Arrival, expected_success, stands, tolerance_m
from datagen.train.inputs import F64
from datagen.train.prediction.base_cells import STATES, BaseCells


@dataclass(frozen=True, eq=False)
class Choice:
    """The chosen base pose, as a row of the cells; None where none may be chosen."""

    best: int | None
    nominal: int | None  # the row with the best score
    expected: F64 | None  # (N,) success expected with the arrival error; None without one
    miss_m: float | None  # distance by which the robot may miss the best while scores stay good


def choose(
    score: F64, cells: BaseCells, allowed: Sequence[str], threshold: float, arrival: Arrival | None
) -> Choice:
    """The best of the cells in an `allowed` state; with an arrival error by the mean score on arrival.

    A robot that arrives where a base is in another state fails. Scores from `threshold` on are good; without
    a threshold (nan) there is no `miss_m`.
    """
    can_stand = np.isin(cells.state, [STATES.index(name) for name in allowed])
    rows = np.flatnonzero(can_stand)
    if not len(rows):
        return Choice(None, None, None, None)
    nominal = int(rows[np.argmax(score[rows])])
    side = round(float(np.sqrt(len(score))))
    step_m = float(np.ptp(cells.offset_m[:, 0]) / (side - 1))
    value = stands(score, can_stand).reshape(side, side)
    expected = None if arrival is None else expected_success(value, step_m, arrival).ravel()
    best = nominal if expected is None else int(rows[np.argmax(expected[rows])])
    if np.isnan(threshold):
        return Choice(best, nominal, expected, None)
    return Choice(best, nominal, expected, tolerance_m(value, step_m, divmod(best, side), threshold))

"""Counts of wrong labels in cells of the floor around the target."""

from __future__ import annotations

from typing import Any

import numpy as np

from datagen.workers.bases.candidate_sets import Bools, Floats

CELL_M = 0.1
HALF_CELLS = 15  # cells to each side of the target; farther candidates are not in the map


def error_map(predicted: Bools, true: Bools, edge_xy_m: Floats) -> dict[str, Any]:
    """Counts of candidates by cell of the floor, in the frame of `target_frame.in_edge_frame`.

    `predicted` and `true` are (N,), `edge_xy_m` is (N, 2). The lists of the result have an entry for each
    cell with candidates: its centre, their number, and those that only `predicted` or only `true` calls good.
    """
    cell = np.floor(edge_xy_m / CELL_M).astype(np.int64) + HALF_CELLS
    side = 2 * HALF_CELLS
    rows = ((cell >= 0) & (cell < side)).all(axis=1)
    flat = cell[rows, 0] * side + cell[rows, 1]
    kinds = (np.ones(len(predicted), np.bool_), predicted & ~true, ~predicted & true)
    counts, false_positive, false_negative = (
        np.bincount(flat, weights=kind[rows], minlength=side * side).astype(np.int64) for kind in kinds
    )
    held = np.flatnonzero(counts)
    centre_m = (np.stack(np.divmod(held, side)) - HALF_CELLS + 0.5) * CELL_M
    return {
        "frame": "origin at the target, -y across the nearest edge of its support, from above",
        "cell_m": CELL_M,
        "outside": int(len(predicted) - rows.sum()),
        "x_m": centre_m[0].round(3).tolist(),
        "y_m": centre_m[1].round(3).tolist(),
        "count": counts[held].tolist(),
        "false_positive": false_positive[held].tolist(),
        "false_negative": false_negative[held].tolist(),
    }

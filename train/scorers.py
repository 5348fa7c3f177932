"""What judges candidates, model or baseline: one score each, and the score from which on it says good."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from train.inputs import Array, Batch


class Scorer(Protocol):
    """A method that can be held against labels.

    From `threshold` on a score says label 1. A threshold of nan belongs to a method that only picks: it
    calls the best-scored of a robot's candidates good, and all others bad.
    """

    @property
    def name(self) -> str: ...

    @property
    def threshold(self) -> float: ...

    def score(self, batch: Batch[Array]) -> npt.NDArray[np.float64]:
        """Scores (N,) of a batch's candidates; higher is better."""
        ...

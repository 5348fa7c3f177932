"""What plain methods have in common: the interface, the numbers that they judge by, and fitting a cut."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, Self
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from datagen.schemas.errors import InputError
from datagen.train.inputs import Array, Batch, is_clear, mount_distance_m
from datagen.train.observed_visibility import observed_visibility
from datagen.train.scorers import Scorer

F64 = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

# Columns that a batch must bring along for baselines.
FIELDS = ("base_is_clear", "base_clearance_m", "object_name")
# Above any distance and probability: a candidate that is ruled out is worse by it than any other.
RULED_OUT = 100.0


class Baseline(Scorer, Protocol):
    """A scorer without a network over clouds, perhaps with a few fitted numbers."""

    @property
    def needs_fit(self) -> bool:
        """Whether it cannot score before `fit`."""
        ...

    def fit(self, batches: Sequence[Batch[Array]]) -> Self:
        """The same with its numbers fitted to the labels, for the best balanced accuracy or likelihood.

        What has no numbers returns itself. InputError where all labels are alike.
        """
        ...

    def state(self) -> dict[str, Any]:
        """Its numbers, as values that JSON can hold."""
        ...


class Unfitted:
    """What a method has that has nothing to fit, and no numbers."""

    needs_fit = False

    def fit(self, batches: Sequence[Batch[Array]]) -> Self:
        return self

    def state(self) -> dict[str, Any]:
        return {}


def planar_distance_m(batch: Batch[Array]) -> F64:
    """Distance (N,) on the floor from each base to the target's centre."""
    return np.linalg.norm(batch.candidates.base_xy_m.astype(np.float64), axis=1)


def mount_m(batch: Batch[Array]) -> F64:
    """Distance (N,) from each arm's mount to the target's centre."""
    return mount_distance_m(batch.clouds, batch.robots, batch.candidates)


def reach_m(batch: Batch[Array]) -> F64:
    """Reach (N,) of each candidate's arm."""
    return batch.robots.arm_reach_m[batch.candidates.robot_row].astype(np.float64)


def is_feasible(batch: Batch[Array]) -> Bools:
    """Where (N,) the base fits and the target is within the arm's reach."""
    return is_clear(batch) & (mount_m(batch) <= reach_m(batch))


_KNOWN_RHO: WeakKeyDictionary[Batch[Array], F64] = WeakKeyDictionary()


def observed_rho(batch: Batch[Array]) -> F64:
    """Estimated rho (N,), worked out once for all baselines that ask of the same batch."""
    if batch not in _KNOWN_RHO:
        _KNOWN_RHO[batch] = observed_visibility(batch.clouds, batch.robots, batch.candidates)
    return _KNOWN_RHO[batch]


def labels(batches: Sequence[Batch[Array]], of: str) -> Bools:
    """All labels (N,). InputError where they are all alike, since nothing can be fitted to them."""
    found = np.concatenate([np.zeros(0, np.int64), *(b.label for b in batches)]) == 1
    if found.all() or not found.any():
        problem = f"all {len(found):,} labels are alike, and nothing can be fitted to them"
        raise InputError(f"baseline {of}", "label", problem, "Fit on runs with labels of both kinds")
    return found


def best_cut(score: F64, label: Bools) -> float:
    """The threshold on scores (N,) with the best balanced accuracy; halfway between the scores it parts.

    Of equally good ones the lowest. Both classes must be there.
    """
    order = np.argsort(score, kind="stable")
    s, y = score[order], label[order]
    # Calling all from row k on good.
    true_good = y.sum() - np.concatenate([[0], np.cumsum(y)])
    true_bad = np.concatenate([[0], np.cumsum(~y)])
    balanced = 0.5 * (true_good / y.sum() + true_bad / (~y).sum())
    allowed = np.concatenate([[True], s[1:] > s[:-1], [False]])
    k = int(np.argmax(np.where(allowed, balanced, -1)))
    return float(s[0]) if k == 0 else float((s[k - 1] + s[k]) / 2)

"""The shards of a job without an attempt so far, in an order that avoids other drivers."""

from __future__ import annotations

import random
from collections.abc import Sequence

import numpy as np

from datagen.schemas.shard_ranges import ShardRanges


class OpenShards:
    """Gives shards in ascending order from a random start, then from the first one on.

    Drivers with the same start would make every shard twice. A driver that meets another one continues at a
    new random position. Memory: 16 bytes per range of consecutive shards.
    """

    def __init__(self, shards: Sequence[int], rng: random.Random) -> None:
        self._rng = rng
        self._begin(ShardRanges.of(shards), None)
        self.go_elsewhere()

    def __len__(self) -> int:
        return len(self._present) + self._after

    def next(self) -> int | None:
        """The next shard; None after the last."""
        if not self._present:
            if self._at + 1 >= len(self._bounds):
                return None
            self._enter(self._at + 1)
        shard = self._present[0]
        self._present = self._present[1:]
        return shard

    def go_elsewhere(self) -> None:
        """Continue at a random position among the remaining shards."""
        left = self._left()
        self._begin(left, left[self._rng.randrange(len(left))] if left else None)

    def keep(self, missing: ShardRanges) -> int:
        """Drop the shards that are not in `missing`; return their number.

        Where the next shard is dropped, another driver works here: continue at a random position.
        """
        before = self._left()
        left = before.within(missing)
        dropped = len(before) - len(left)
        if dropped:
            ahead = self._present[0] if self._present else None
            self._begin(left, ahead)
            if ahead is None or ahead not in left:
                self.go_elsewhere()
        return dropped

    def _left(self) -> ShardRanges:
        rest = self._bounds[self._at + 1 :]
        if self._present:
            rest = np.concatenate([rest, [[self._present.start, self._present.stop]]])
        return _joined(rest)

    def _begin(self, left: ShardRanges, start: int | None) -> None:
        """Give `left` from `start` on and, after its end, from the first one on."""
        bounds = left.bounds
        if start is not None and start in left:
            row = int(np.searchsorted(bounds[:, 1], start, side="right"))
            first, past = bounds[row]
            head = [[first, start]] if first < start else np.empty((0, 2), np.int64)
            bounds = np.concatenate([[[start, past]], bounds[row + 1 :], bounds[:row], head])
        self._bounds = bounds.astype(np.int64)
        self._at, self._present = -1, range(0)
        self._after = len(left)
        if len(bounds):
            self._enter(0)

    def _enter(self, row: int) -> None:
        self._at = row
        self._present = range(int(self._bounds[row, 0]), int(self._bounds[row, 1]))
        self._after -= len(self._present)


def _joined(bounds: np.ndarray) -> ShardRanges:  # type: ignore[type-arg]
    """Ranges in any order as a set; adjacent ones are joined."""
    bounds = bounds[np.argsort(bounds[:, 0])].astype(np.int64)
    if not len(bounds):
        return ShardRanges(bounds)
    first = np.concatenate([[True], bounds[1:, 0] != bounds[:-1, 1]])
    last = np.concatenate([first[1:], [True]])
    return ShardRanges(np.stack([bounds[first, 0], bounds[last, 1]], axis=1))

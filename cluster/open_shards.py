"""The shards of a job that no attempt here was made at yet, in an order that keeps clear of other drivers."""

from __future__ import annotations

import random
from collections.abc import Sequence

import numpy as np

from datagen.schemas.shard_ranges import ShardRanges


class OpenShards:
    """Gives shards in ascending order from a random one on, and from the first one behind the last.

    Drivers that begin at the same shard would make every shard twice. One that runs into another goes on
    at another random place.
    16 bytes a range of neighbours, however many shards there are.
    """

    def __init__(self, shards: Sequence[int], rng: random.Random) -> None:
        self._rng = rng
        self._begin(ShardRanges.of(shards), None)
        self.go_elsewhere()

    def __len__(self) -> int:
        return len(self._present) + self._after

    def next(self) -> int | None:
        """The next shard; None when all were given out."""
        if not self._present:
            if self._at + 1 >= len(self._bounds):
                return None
            self._enter(self._at + 1)
        shard = self._present[0]
        self._present = self._present[1:]
        return shard

    def go_elsewhere(self) -> None:
        """Go on at a random place among the shards that are left."""
        left = self._left()
        self._begin(left, left[self._rng.randrange(len(left))] if left else None)

    def keep(self, missing: ShardRanges) -> int:
        """Drop the shards that are not in `missing`; return how many those were.

        Where the very next shard is dropped, somebody works right here: it goes on elsewhere.
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
        """Give out `left` from `start` on and, behind its end, from the first one again."""
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
    """Ranges in any order as a set; neighbours become one."""
    bounds = bounds[np.argsort(bounds[:, 0])].astype(np.int64)
    if not len(bounds):
        return ShardRanges(bounds)
    first = np.concatenate([[True], bounds[1:, 0] != bounds[:-1, 1]])
    last = np.concatenate([first[1:], [True]])
    return ShardRanges(np.stack([bounds[first, 0], bounds[last, 1]], axis=1))

"""The shards of a job without an attempt so far, in an order that avoids other drivers."""

from __future__ import annotations

import random
from collections.abc import Sequence

from datagen.schemas.shard_ranges import ShardRanges


class OpenShards:
    """Gives shards in ascending order from a random start, then from the first one on.

    Drivers with the same start would make every shard twice. A driver that meets another one continues at a
    new random position. Memory: 16 bytes per range of consecutive shards.
    """

    def __init__(self, shards: Sequence[int], rng: random.Random) -> None:
        self._rng = rng
        self._begin(ShardRanges.of(shards))

    def __len__(self) -> int:
        return len(self._shards) - self._given

    def next(self) -> int | None:
        """The next shard; None after the last."""
        if not len(self):
            return None
        self._given += 1
        return self._shards[(self._start + self._given - 1) % len(self._shards)]

    def go_elsewhere(self) -> None:
        """Continue at a random position among the remaining shards."""
        self._begin(self._left())

    def keep(self, missing: ShardRanges) -> int:
        """Drop the shards that are not in `missing`; return their number.

        Where the next shard is dropped, another driver works here: continue at a random position.
        """
        before = self._left()
        left = before.within(missing)
        if dropped := len(before) - len(left):
            ahead = self._shards[(self._start + self._given) % len(self._shards)]
            self._begin(left, ahead if ahead in left else None)
        return dropped

    def _begin(self, left: ShardRanges, start: int | None = None) -> None:
        """Continue with `left` from `start`, or from a random shard; after the last shard, from the first."""
        self._shards, self._given = left, 0
        if start is not None:
            self._start = left.position_of(start)
        else:
            self._start = self._rng.randrange(len(left)) if left else 0

    def _left(self) -> ShardRanges:
        size, end, left = len(self._shards), self._start + self._given, self._shards
        for first, past in ((self._start, min(end, size)), (0, end - size)):
            if first < past:  # consecutive shards of the set
                given = range(self._shards[first], self._shards[past - 1] + 1)
                left = left.without(ShardRanges.of(given))
        return left

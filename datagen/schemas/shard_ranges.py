"""Sets of shard or scene numbers as ranges, since a run may have millions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from operator import eq
from typing import Any, overload

import numpy as np

Bounds = np.ndarray[Any, np.dtype[np.int64]]


class ShardRanges(Sequence[int]):
    """An immutable set of shard numbers, 16 bytes per range of consecutive ones.

    `bounds` is an int64 array (ranges, 2): first and one past the last shard of each, ascending, disjoint.
    """

    def __init__(self, bounds: Bounds) -> None:
        self.bounds = bounds
        self._ends = np.cumsum(bounds[:, 1] - bounds[:, 0])  # shards up to the end of each range

    @classmethod
    def between(cls, ranges: Iterable[tuple[int, int]]) -> ShardRanges:
        """The set of ascending, disjoint ranges, each (first, one past the last)."""
        return cls(np.array(list(ranges), np.int64).reshape(-1, 2))

    @property
    def ranges(self) -> tuple[tuple[int, int], ...]:
        return tuple((int(first), int(past)) for first, past in self.bounds)

    @classmethod
    def of(cls, shards: Iterable[int] | Bounds) -> ShardRanges:
        """The set of the given shards, in any order."""
        if isinstance(shards, ShardRanges):
            return shards
        if isinstance(shards, range) and shards.step == 1:
            return cls.between([(shards.start, shards.stop)] if shards else [])
        numbers = np.unique(shards if isinstance(shards, np.ndarray) else np.fromiter(shards, np.int64))
        is_first = np.diff(numbers, prepend=-2) > 1
        is_last = np.append(is_first, True)[1:]
        return cls(np.stack([numbers[is_first], numbers[is_last] + 1], axis=1))

    def union(self, others: ShardRanges) -> ShardRanges:
        more = others.without(self)
        bounds = np.concatenate([self.bounds, more.bounds])
        return _ALL.without(_ALL.without(ShardRanges(bounds[np.argsort(bounds[:, 0])])))

    def times(self, size: int) -> ShardRanges:
        """The numbers in the blocks of `size` consecutive numbers that these count."""
        return ShardRanges(self.bounds * size)

    def blocks(self, size: int) -> ShardRanges:
        """The blocks of `size` consecutive numbers that hold one of these."""
        first, past = self.bounds[:, 0] // size, -(-self.bounds[:, 1] // size)
        first = np.maximum(first, np.concatenate([[0], past])[: len(first)])  # two ranges may share a block
        return ShardRanges(np.stack([first, past], axis=1)[first < past])

    def within(self, others: ShardRanges) -> ShardRanges:
        return self.without(self.without(others))

    def without(self, others: ShardRanges) -> ShardRanges:
        # Sweep over all bounds: +1 within this set and -1 within the other, so 1 where only this one is.
        numbers = np.concatenate([*self.bounds.T, *others.bounds.T])
        steps = np.repeat([1, -1, -1, 1], [len(self.bounds)] * 2 + [len(others.bounds)] * 2)
        order = np.argsort(numbers, kind="stable")
        numbers, depth = numbers[order], np.cumsum(steps[order])
        last = np.append(numbers[1:] != numbers[:-1], True) if len(numbers) else np.empty(0, bool)
        numbers, inside = numbers[last], (depth[last] == 1)
        edges = np.diff(np.concatenate([[False], inside, [False]]).astype(np.int8))
        first, past = numbers[np.flatnonzero(edges == 1)], numbers[np.flatnonzero(edges == -1)]
        return ShardRanges(np.stack([first, past], axis=1).reshape(-1, 2))

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def __iter__(self) -> Iterator[int]:
        for first, past in self.bounds:
            yield from range(int(first), int(past))

    @overload
    def __getitem__(self, index: int) -> int: ...

    @overload
    def __getitem__(self, index: slice) -> list[int]: ...

    def __getitem__(self, index: int | slice) -> int | list[int]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        at = range(len(self))[index]
        row = int(np.searchsorted(self._ends, at, side="right"))
        return int(self.bounds[row, 1] - (self._ends[row] - at))

    def position_of(self, shard: int) -> int:
        row = int(np.searchsorted(self.bounds[:, 1], shard, side="right"))
        return int(self._ends[row] - (self.bounds[row, 1] - shard))

    def __contains__(self, shard: object) -> bool:
        if not isinstance(shard, int):
            return False
        row = int(np.searchsorted(self.bounds[:, 1], shard, side="right"))
        return row < len(self.bounds) and bool(self.bounds[row, 0] <= shard)

    def __eq__(self, other: object) -> bool:
        if isinstance(other, ShardRanges):
            return np.array_equal(self.bounds, other.bounds)
        return isinstance(other, Sequence) and len(self) == len(other) and all(map(eq, self, other))

    def __hash__(self) -> int:
        return hash(self.bounds.tobytes())

    def __repr__(self) -> str:
        shown = ", ".join(f"{first}-{past - 1}" for first, past in self.bounds[:10])
        return f"ShardRanges({shown}{', ...' if len(self.bounds) > 10 else ''})"


_ALL = ShardRanges.of(range(2**62))

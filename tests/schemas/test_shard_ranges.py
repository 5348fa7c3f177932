"""Ranges of shards are the sets that they stand for."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.schemas.shard_ranges import ShardRanges

SETS = st.sets(st.integers(0, 60), max_size=40)


@given(SETS, SETS)
def test_they_are_sets_of_numbers(a: set[int], b: set[int]) -> None:
    ours, theirs = ShardRanges.of(sorted(a, reverse=True)), ShardRanges.of(b)
    assert ours == sorted(a) and list(ours) == sorted(a) and len(ours) == len(a)
    assert [ours[i] for i in range(-len(a), len(a))] == sorted(a) * 2
    assert ours[1:7:2] == sorted(a)[1:7:2]
    assert ours.without(theirs) == sorted(a - b)
    assert ours.within(theirs) == sorted(a & b)
    assert {shard for shard in range(-1, 62) if shard in ours} == a
    assert (ours == theirs) == (a == b) and (a != b or hash(ours) == hash(theirs))


def test_a_planned_trillion_costs_nothing() -> None:
    planned = ShardRanges.of(range(10**12))
    open_ = planned.without(ShardRanges.of([0, 1, 5 * 10**11]))
    assert len(open_) == 10**12 - 3 and open_[0] == 2 and open_[-1] == 10**12 - 1
    assert open_.bounds.nbytes == 32
    with pytest.raises(IndexError):
        open_[len(open_)]
    assert ShardRanges.of(range(5, 5)) == [] and "x" not in planned

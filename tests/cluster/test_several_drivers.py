"""Drivers of one run beside each other: each shard once, little made twice."""

from __future__ import annotations

import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.cluster.shard_policy import OpenShards
from datagen.schemas.run_records import ShardRanges
from tests.cluster.several_drivers import drive_together, waste


@given(st.sets(st.integers(0, 80)), st.integers(0, 2**32), st.lists(st.integers(0, 3), max_size=80))
def test_open_shards_are_given_once_or_dropped(shards: set[int], seed: int, moves: list[int]) -> None:
    rng, open_ = random.Random(seed), OpenShards(sorted(shards), random.Random(seed))
    given_out: list[int] = []
    dropped: set[int] = set()
    for move in moves:
        if move == 0:
            open_.go_elsewhere()
        elif move == 1:
            gone = {shard for shard in shards if rng.random() < 0.2}
            dropped |= gone - set(given_out)
            before = len(open_)
            assert open_.keep(ShardRanges.of(shards - gone)) == before - len(open_)
        elif (shard := open_.next()) is not None:
            given_out.append(shard)
    while (shard := open_.next()) is not None:
        given_out.append(shard)
    assert len(open_) == 0 and len(set(given_out)) == len(given_out)
    assert set(given_out) | dropped == shards and not set(given_out) & dropped


@pytest.mark.parametrize(
    ("drivers", "shards", "attempts", "share"),
    # Wasted attempts and their share of all time, at most, in the mean. Two slots and four attempts in
    # flight a driver: of ten shards, four drivers cannot but make some twice.
    [(2, 10, 11, 0.36), (4, 10, 23, 0.53), (2, 100, 22, 0.11), (4, 100, 48, 0.19)],
)
def test_drivers_that_begin_together_waste_little(
    drivers: int, shards: int, attempts: float, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = np.random.default_rng(0)
    monkeypatch.setattr("datagen.cluster.driver.secrets.token_hex", lambda n: names.bytes(n).hex())
    wasted = []
    for _ in range(12):
        summaries = drive_together(drivers, shards)
        assert sum(summary.totals.committed for summary in summaries) == shards
        assert all(summary.end == "complete" and not summary.remaining for summary in summaries)
        wasted.append(waste(summaries))
    assert np.all(np.mean(wasted, axis=0) <= (attempts, share))


def test_open_shards_come_in_order_without_another_driver() -> None:
    for seed in range(20):
        open_ = OpenShards([7, 3, 4, 1], random.Random(seed))
        given_out = [open_.next() for _ in range(5)]
        assert given_out[4] is None and sorted(given_out[:4]) == [1, 3, 4, 7]
        at = given_out.index(1)
        assert given_out[at:4] + given_out[:at] == [1, 3, 4, 7]  # from the first one behind the last
    open_ = OpenShards(range(10), random.Random(0))
    at = open_.next()
    assert open_.next() == (at + 1) % 10
    left = [(at + ahead) % 10 for ahead in (2, 3, 8, 9)]
    assert open_.keep(ShardRanges.of(left)) == 4  # others are far ahead: it stays here
    assert [open_.next() for _ in range(5)] == [*left, None]

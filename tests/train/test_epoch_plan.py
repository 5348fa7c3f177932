"""The order of an epoch: what holds for any data, batches, buffers and ranks."""

from __future__ import annotations

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from datagen.train.dataset import EpochPlan, batches_of, plan_epoch

SHARDS = st.lists(st.integers(1, 6), min_size=1, max_size=12)  # scenes of each
ASKED = st.tuples(st.integers(1, 9), st.integers(1, 5))  # scenes a batch, shards a buffer


def plans(sizes: list[int], asked: tuple[int, int], seed: int | None, world: int) -> list[EpochPlan]:
    shard = np.repeat(np.arange(len(sizes)), sizes)
    rngs = [None if seed is None else np.random.default_rng(seed) for _ in range(world)]
    return [plan_epoch(shard, *asked, rngs[rank], rank, world) for rank in range(world)]


@given(SHARDS, ASKED, st.none() | st.integers(0, 99), st.integers(1, 5))
@settings(max_examples=150, deadline=None)
def test_ranks_have_equal_numbers_of_scenes_and_batches(
    sizes: list[int], asked: tuple[int, int], seed: int | None, world: int
):
    n = sum(sizes)
    assume(n >= world)
    made = plans(sizes, asked, seed, world)
    order = np.concatenate([p.order for p in made]).tolist()
    assert (order if seed is None else sorted(order)) == list(range(n))
    batches = batches_of(n, asked[0], world)
    for plan in made:
        assert len(plan.cuts) == batches + 1
        counts = np.diff(plan.cuts)
        assert counts.min() >= 1
        assert counts.max() - counts.min() <= 1
        assert counts.max() <= max(asked[0], 2)
        assert counts.sum() == len(plan.order)
    assert max(len(p.order) for p in made) - min(len(p.order) for p in made) <= 1


@given(SHARDS, ASKED, st.integers(0, 99), st.integers(1, 4))
@settings(max_examples=100, deadline=None)
def test_scenes_are_shuffled_within_a_buffer_of_whole_shards(
    sizes: list[int], asked: tuple[int, int], seed: int, world: int
):
    assume(sum(sizes) >= world)
    shard = np.repeat(np.arange(len(sizes)), sizes)
    for plan in plans(sizes, asked, seed, world):
        assert (np.diff(plan.buffer) >= 0).all()
        held = [set(shard[plan.order[plan.buffer == b]].tolist()) for b in range(plan.buffer[-1] + 1)]
        assert all(len(some) <= asked[1] for some in held)
        assert sum(map(len, held)) == len(set().union(*held))  # no shard is read twice by one rank
        assert all(len(some) == asked[1] for some in held[:-1])


def test_the_first_of_25_batches_takes_scenes_from_most_of_a_buffers_shards():
    (plan,) = plans([4] * 50, (8, 8), seed=1, world=1)
    assert len(set((plan.order[:8] // 4).tolist())) >= 4

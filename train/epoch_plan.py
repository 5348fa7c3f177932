"""The order of an epoch's scenes, known before reading, so that any batch can be the first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datagen.train.inputs import I64


@dataclass(frozen=True, eq=False)
class EpochPlan:
    """Batch i of a rank is `order[cuts[i]:cuts[i + 1]]`; scenes of one `buffer` are read together."""

    order: I64  # (n,)
    buffer: I64  # (n,)
    cuts: I64  # (batches + 1,)


def batches_of(n_scenes: int, scenes_per_batch: int, world: int) -> int:
    """Number of batches per rank: none is empty, and none larger than requested where scenes suffice."""
    largest_rank = -(-n_scenes // world)
    return max(1, min(-(-largest_rank // scenes_per_batch), n_scenes // world))


def plan_epoch(
    shard: I64,
    scenes_per_batch: int,
    buffer_shards: int,
    rng: np.random.Generator | None,
    rank: int,
    world: int,
) -> EpochPlan:
    """The order of one rank's scenes, given each scene's shard (S,), ascending.

    With `rng`, shards are permuted; each rank takes its equal stretch of them, so that it reads little
    else (a shard on a border is read by two); scenes are shuffled within every `buffer_shards` shards of
    the stretch. Without, scenes keep their stored order. Batches differ by one scene at most.
    """
    n, batches = len(shard), batches_of(len(shard), scenes_per_batch, world)
    if rng is None:
        order, luck = np.arange(n), None
    else:
        kept, place = np.unique(shard, return_inverse=True)
        order = np.argsort(rng.permutation(len(kept))[place], kind="stable")
        luck = rng.random(n)
    first, past = rank * n // world, (rank + 1) * n // world
    order = order[first:past]
    buffer = np.cumsum(np.diff(shard[order], prepend=shard[order[0]]) != 0) // buffer_shards
    if luck is not None:
        order = order[np.lexsort([luck[first:past], buffer])]
    cuts = np.arange(batches + 1) * len(order) // batches
    return EpochPlan(order, buffer, cuts)

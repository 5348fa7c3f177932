"""Batches of encoded scenes, in nested subsets of houses."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

import numpy as np

from datagen.train.encoded.runs import EncodedRuns
from datagen.train.inputs import I64, Array, Batch, Bools

# One in this number of houses is held out where a training has no validation runs.
_HELD_OUT = 10


class EncodedBatches:
    """Epochs of batches of some scenes, as `run_training` reads them."""

    def __init__(
        self, encoded: EncodedRuns, scenes: I64, scenes_per_batch: int, seed: int | None = None
    ) -> None:
        """With `seed` the scenes are shuffled in each epoch; without, they keep their order."""
        self._encoded, self._scenes, self._seed = encoded, scenes, seed
        self.batches_per_epoch = max(1, -(-len(scenes) // scenes_per_batch))

    def epoch(self, k: int, skip_batches: int = 0) -> Iterator[Batch[Array]]:
        """Batches of epoch k from batch `skip_batches` on."""
        order = self._scenes
        if self._seed is not None:
            order = np.random.default_rng([self._seed, k]).permutation(order)
        for some in np.array_split(order, self.batches_per_epoch)[skip_batches:]:
            yield self._encoded.batch(some)

    @property
    def n_samples(self) -> int:
        """Candidates of one epoch."""
        return int(self._chosen().sum())

    def class_counts(self) -> tuple[int, int]:
        """(negatives, positives) of one epoch."""
        positives = int(self._encoded.label[self._chosen()].sum())
        return self.n_samples - positives, positives

    def _chosen(self) -> Bools:
        return np.isin(self._encoded.scene_of_candidate, self._scenes)


def house_order(houses: Array, seed: int) -> list[str]:
    """The distinct houses in an order that depends on seed and id alone."""
    names = sorted({str(house) for house in houses})
    return sorted(names, key=lambda name: hashlib.sha256(f"house-order-1:{seed}:{name}".encode()).digest())


def subset_of_houses(encoded: EncodedRuns, share: float, seed: int) -> I64:
    """Scenes (n,) of the first `share` of the houses in `house_order`: larger shares hold smaller ones."""
    order = house_order(encoded.houses, seed)
    chosen = order[: max(1, round(share * len(order)))]
    return np.flatnonzero(np.isin(encoded.houses, chosen))


def hold_out(encoded: EncodedRuns, scenes: I64, seed: int) -> tuple[I64, I64]:
    """(training, validation) scenes: every tenth house in `house_order` is held out, with fewer the last."""
    present = set(np.unique(encoded.houses[scenes]).tolist())
    order = [name for name in house_order(encoded.houses, seed) if name in present]
    held = order[_HELD_OUT - 1 :: _HELD_OUT] or order[-1:]
    out = np.isin(encoded.houses[scenes], held)
    return scenes[~out], scenes[out]

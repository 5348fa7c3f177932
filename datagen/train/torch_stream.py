"""A stream of samples as PyTorch reads data: an IterableDataset of batches of tensors."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypedDict

import torch
from torch.utils.data import IterableDataset, get_worker_info
from typing_extensions import Unpack

from datagen.train.dataset import SampleStream
from datagen.train.inputs import Batch
from datagen.train.tensors import to_torch


class StreamOptions(TypedDict, total=False):
    """Options of SampleStream."""

    scenes_per_batch: int
    candidates_per_robot: int | None
    seed: int
    buffer_shards: int
    houses: Callable[[str], bool] | None
    extra: Sequence[str]
    shuffle: bool
    rank: int
    world: int
    allow_incomplete: bool


class TorchStream(SampleStream, IterableDataset[Batch[torch.Tensor]]):
    """A SampleStream that a `torch.utils.data.DataLoader` reads; iterating gives one epoch.

    Its items are whole batches, so the loader is made with `batch_size=None`. With any `num_workers` the
    loader gives the same batches in the same order, each sample once. `set_epoch` chooses the epoch, and
    where in it to begin: a training that stopped after `skip_batches` batches continues with the next.
    """

    def __init__(self, paths: Sequence[str | Path], **options: Unpack[StreamOptions]) -> None:
        super().__init__(paths, **options)
        # Shared, so that the processes of a loader with persistent workers see what `set_epoch` sets.
        self._begin = torch.zeros(2, dtype=torch.int64).share_memory_()

    def set_epoch(self, epoch: int, skip_batches: int = 0) -> None:
        """Let the next iteration give this epoch from batch `skip_batches` on."""
        self._begin[0], self._begin[1] = epoch, skip_batches

    def __iter__(self) -> Iterator[Batch[torch.Tensor]]:
        info = get_worker_info()
        worker, workers = (0, 1) if info is None else (info.id, info.num_workers)
        epoch, skip = self._begin.tolist()
        for batch in self.epoch(epoch, skip + worker, every=workers):
            yield to_torch(batch, "cpu")

    def __len__(self) -> int:
        return self.batches_per_epoch - min(int(self._begin[1]), self.batches_per_epoch)


def stream(*paths: str | Path, **options: Unpack[StreamOptions]) -> TorchStream:
    """Return the labels of runs as a torch IterableDataset of batches, for a training loop of your own.

    A batch holds whole scenes: their clouds, the robots that look at them, the candidate base poses and
    their labels, as tensors (`datagen.train.inputs` has shapes, units and frames).

    Args:
        paths: Folders or `s3://` addresses of runs, merged runs or sealed `data.zarr` stores.
        options: `scenes_per_batch` [16], `candidates_per_robot` [all], `seed` [0] of the order,
            `shuffle` [True], `buffer_shards` to shuffle in [8], `houses` (a function of house_id that
            selects houses), `extra` columns, `rank` and `world` of distributed training, and
            `allow_incomplete`.

    Raises:
        InputError: A path is no run, a run is incomplete or damaged, or an option is out of range.

    Examples:
        >>> batches = datagen.stream(run, scenes_per_batch=1)
        >>> loader = torch.utils.data.DataLoader(batches, batch_size=None, num_workers=0)
        >>> for epoch in range(2):
        ...     batches.set_epoch(epoch)
        ...     print(sum(len(batch.label) for batch in loader))
        16
        16
    """
    return TorchStream(paths, **options)

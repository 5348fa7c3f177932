"""The stream as torch's DataLoader reads it: each sample once, in one order, for any number of workers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, IterableDataset

import datagen
from tests.train.stream_runs import make_stream_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stream") / "run"
    make_stream_run(folder, 120)
    return folder


def ids_of(batches: Any) -> list[bytes]:
    return [batch.sample_id.tobytes() for batch in batches]


def test_it_is_an_iterable_dataset_of_tensors_that_continues_where_a_training_stopped(run: Path) -> None:
    stream = datagen.stream(run, scenes_per_batch=3)
    assert isinstance(stream, IterableDataset) and len(stream) == stream.batches_per_epoch == 7
    first, *rest = stream
    assert isinstance(first.label, torch.Tensor) and first.clouds.points_m.dtype == torch.float32
    stream.set_epoch(0, skip_batches=1)
    assert ids_of(stream) == ids_of(rest) and len(stream) == 6
    stream.set_epoch(0, skip_batches=100)
    assert ids_of(stream) == [] and len(stream) == 0


@pytest.mark.parametrize("workers", [1, 2])
def test_workers_give_the_batches_of_one_process_in_its_order(run: Path, workers: int) -> None:
    stream = datagen.stream(run, scenes_per_batch=3, seed=5)
    stream.set_epoch(2)
    alone = ids_of(stream.epoch(2))
    assert len(np.unique(np.frombuffer(b"".join(alone), np.uint8).reshape(-1, 16), axis=0)) == 120
    loader = DataLoader(stream, batch_size=None, num_workers=workers, persistent_workers=True)
    assert len(loader) == 7 and ids_of(loader) == alone
    stream.set_epoch(3, skip_batches=4)  # also in workers that live on
    assert ids_of(loader) == ids_of(stream.epoch(3))[4:] != alone[4:]


def test_runs_on_an_object_store_are_read_by_workers_that_are_spawned(bucket: str) -> None:
    make_stream_run(f"{bucket}/run", 40)
    stream = datagen.stream(f"{bucket}/run", scenes_per_batch=2)
    loader = DataLoader(stream, batch_size=None, num_workers=1, multiprocessing_context="spawn")
    assert ids_of(loader) == ids_of(stream)
    table = datagen.candidates(f"{bucket}/run")
    assert table["label"].tolist() == datagen.open_dataset(f"{bucket}/run")["label"].values.tolist()

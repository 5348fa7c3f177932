"""Batches as tensors: the same numbers, text and names as they were."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datagen.train.dataset import SampleStream
from tests.train.stream_runs import make_stream_run

torch = pytest.importorskip("torch", reason="the extra `train` is not installed")


def test_a_batch_becomes_tensors_on_the_device(tmp_path: Path):
    from datagen.train.tensors import to_torch

    make_stream_run(tmp_path, 36)
    extra = ("house_id", "distance_m", "redraws", "T_world_camera", "points_m")
    (batch,) = SampleStream([tmp_path], extra=extra).epoch(0)
    for device in ("cpu", *(["cuda"] if torch.cuda.is_available() else [])):
        moved = to_torch(batch, device)
        for name in ("clouds", "robots", "candidates"):
            for field, values in vars(getattr(batch, name)).items():
                tensor = getattr(getattr(moved, name), field)
                if field == "name":
                    assert tensor is values and values.dtype.kind == "U"
                    continue
                assert tensor.device.type == device
                np.testing.assert_array_equal(tensor.cpu().numpy(), values)
                assert tensor.cpu().numpy().dtype == values.dtype
        assert moved.label.dtype == torch.int64
        assert moved.sample_id is batch.sample_id
        assert moved.extra["house_id"] is batch.extra["house_id"]
        assert moved.extra["redraws"].dtype == torch.int64
        for field in extra[1:]:
            np.testing.assert_array_equal(moved.extra[field].cpu().numpy(), batch.extra[field])

"""The benchmark of scoring reads runs of any size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.train.stream_runs import make_stream_run

pytest.importorskip("torch", reason="the extra `train` is not installed")


def test_a_run_of_few_scenes_fills_the_batch_of_a_training_step(tmp_path: Path) -> None:
    from benchmarks.scoring import _batch, _stored_clouds

    make_stream_run(tmp_path, 12)
    clouds = _stored_clouds(str(tmp_path))
    assert len(clouds) < 4
    batch = _batch(clouds, robots=4, candidates=15, scenes=4)
    assert len(batch.clouds) == 4
    assert batch.robots.cloud_row.max() == 3
    np.testing.assert_array_equal(batch.clouds.points_m[len(clouds)], clouds.points_m[0])

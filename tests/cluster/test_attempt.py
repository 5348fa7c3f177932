"""One attempt by itself: what ends the job, and what concerns the attempt alone."""

from __future__ import annotations

from pathlib import Path

import pytest

from cluster.attempt import run_attempt
from cluster.guard import Meter
from cluster.task import JobCannotGoOn, ShardTask
from schemas.run_records import Layout
from tests.made_runs import make_run, small_spec


def test_a_run_or_sources_that_cannot_be_opened_end_the_job(tmp_path: Path) -> None:
    spec, layout = small_spec(), Layout(scenes_per_shard=2, candidates_per_scene=5)
    task = ShardTask(str(tmp_path / "none"), spec, layout, 3, "a", "builtin", "builtin", 60)
    assert list(task.scene_indices) == [6, 7]
    with pytest.raises(JobCannotGoOn, match="no such folder"):
        run_attempt(task, Meter())
    run = make_run(tmp_path / "run", shards=())
    other = ShardTask(run.storage.url, small_spec(seed=9), layout, 0, "a", "builtin", "builtin", 60)
    with pytest.raises(JobCannotGoOn, match="another specification"):
        run_attempt(other, Meter())

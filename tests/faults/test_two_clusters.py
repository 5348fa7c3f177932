"""Two jobs with a Ray cluster each on one run of an S3 server: no shard is lost or counted twice."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults.cluster_pair import run_pair

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("kill", [False, True])
def test_two_clusters_make_one_run(kill: bool, bucket: str, tmp_path: Path) -> None:
    run_pair(f"{bucket}/run", 12, 0.3, tmp_path, kill)

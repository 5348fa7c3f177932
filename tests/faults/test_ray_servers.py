"""A raylet or a GCS server that is killed: jobs complete or end in one line, and no shard is to blame."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from tests.faults.server_campaign import kill_servers


@pytest.mark.parametrize("kind", ["raylet", "gcs_server"])
def test_a_local_cluster_that_dies_is_started_anew(tmp_path: Path, kind: str) -> None:
    seen = kill_servers(tmp_path, kind, kills=2, shards=10, seconds=0.3, rng=random.Random(0))
    assert seen["jobs"] == 1 and seen["attempts wasted"] <= 2 * 4

"""A raylet or a GCS server that is killed: jobs complete or end in one line, and no shard is to blame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.faults.server_campaign import kill_servers


@pytest.mark.parametrize("kind", ["raylet", "gcs_server"])
def test_a_local_cluster_that_dies_is_started_anew(tmp_path: Path, kind: str) -> None:
    seen = kill_servers(tmp_path, kind, kills=2, shards=8, seconds=0.5, rng=np.random.default_rng(0))
    assert seen["jobs aborted"] == 0 and seen["attempts wasted"] <= 2 * 4

"""A job on an S3 store that fails: nothing lost, nothing doubled, every attempt in the ledger."""

from __future__ import annotations

from pathlib import Path

import pytest

from datagen.schemas.storage import errors
from tests.faults.s3_campaign import campaign
from tests.s3_servers import Faults, environment, faulty_proxy

pytestmark = pytest.mark.slow


def test_a_job_on_a_failing_store_is_resumed_until_it_is_done(
    bucket: str, s3_port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    faults = Faults(
        error=0.03,
        lost_answer=0.02,
        lost_creates=3,
        cut=0.02,
        hold=0.003,
        hold_s=3.0,
        seed=4,
        down_after=[80],
        down_at_commits=[0],
        down_for_s=3.5,
    )
    monkeypatch.setattr(errors, "JOBS_WAIT_S", 0.0)  # so that jobs give up, and are resumed
    with faulty_proxy(s3_port, faults) as port:
        for name, value in environment(port).items():
            monkeypatch.setenv(name, value)
        monkeypatch.setenv("DATAGEN_STORE_TIMEOUT_S", "2")
        outcome = campaign(f"{bucket}/runs/a", 3, faults, tmp_path)
    assert outcome.jobs >= 2 and outcome.executions >= 3
    assert min(outcome.faults[kind] for kind in ("down", "error", "lost_answer", "lost_commit", "cut")) > 0

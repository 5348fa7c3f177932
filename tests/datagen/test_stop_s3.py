"""A job whose S3 store is down, and Ctrl-C: it ends without waiting minutes, and what is committed stays."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from datagen import cli
from datagen.schemas.run import Run
from tests.conftest import REPOSITORY
from tests.datagen.test_resume_s3 import arguments
from tests.s3_servers import Faults, environment, faulty_proxy
from tests.small_runs import HERE, PER_SCENE

SLOW = partial(pytest.param, marks=pytest.mark.slow)


@pytest.mark.parametrize(("workers", "times"), [SLOW("0", 1), ("0", 2), SLOW("1", 1), SLOW("1", 2)])
def test_ctrl_c_ends_a_job_whose_store_is_down(
    bucket: str, s3_port: int, tmp_path: Path, workers: str, times: int, capsys: pytest.CaptureFixture[str]
) -> None:
    faults, path = Faults(down_for_s=1e6), f"{bucket}/run"
    words = arguments(path, 16 * PER_SCENE, tmp_path)
    words[words.index("--workers") + 1] = workers
    with faulty_proxy(s3_port, faults) as port:
        job = subprocess.Popen(
            [sys.executable, "-m", "datagen.cli", *words],
            cwd=REPOSITORY, env=os.environ | environment(port), stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert job.stderr is not None
        for line in job.stderr:
            if "making labels" in line:
                faults.down_at_commits = [2]
            if "waiting for the object store" in line:
                break
        assert faults.down
        for _ in range(times):
            job.send_signal(signal.SIGINT)
            time.sleep(1)  # signals that wait for a program are one
        _, err = job.communicate(timeout=200)  # without Ctrl-C, it would wait for 300 s
        assert job.returncode == 130 and "Traceback" not in err, err
        assert "committed shards are kept" in err and f"datagen resume {path}" in " ".join(err.split())
    kept = {commit.shard: commit for commit in Run.open(path).commits()}
    assert len(kept) >= 2
    assert cli.run(["resume", path, *HERE]) == 0
    whole = {commit.shard: commit for commit in Run.open(path).commits()}
    assert len(whole) == 8 and kept.items() <= whole.items()

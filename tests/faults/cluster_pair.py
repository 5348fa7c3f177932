"""Two jobs, each with a Ray cluster of its own, on one run of an S3 server."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

from datagen.schemas.run import Run
from datagen.schemas.sealing import seal
from tests.conftest import REPOSITORY
from tests.faults.s3_campaign import LAYOUT, check_ledger, check_undisturbed
from tests.made_runs import make_run


def run_pair(address: str, shards: int, seconds: float, folder: Path, kill: bool = False) -> Counter[str]:
    """Let two jobs make the run at the address; with `kill`, one is killed when a third is committed.

    The environment names the server. Raises AssertionError where the run then is not what an undisturbed one
    is. Returns how the attempts of the jobs ended, and how many were wasted.
    """
    run = make_run(address, shards * LAYOUT.samples_per_shard, 2, 5, shards=())
    command = [sys.executable, "-m", "tests.faults.job", address, str(seconds)]
    jobs = [
        subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    while kill and len(run.committed()) < shards // 3:
        assert any(job.poll() is None for job in jobs)
    if kill:
        jobs[0].kill()
    outcomes = Counter[str]()
    for job in jobs:
        out, err = job.communicate(timeout=600)
        if not (kill and job is jobs[0]):
            assert job.returncode == 0 and json.loads(out)["end"] == "complete", err
            outcomes.update(json.loads(out)["outcomes"])
    run = Run.open(address)
    run.close_lost_attempts()
    seal(run.storage)
    check_ledger(run, set())
    check_undisturbed(run, shards, folder / "undisturbed")
    assert kill or outcomes["committed"] == shards, outcomes
    return outcomes + Counter({"wasted": sum(1 for _ in run.ledger.ends())})

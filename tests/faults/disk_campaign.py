"""A run on a btrfs subvolume with a quota, and one on an ext4 file system that stalls."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

from datagen.schemas.checking.check_runs import Checked, check_runs
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from tests.conftest import REPOSITORY
from tests.faults.counted import SAMPLES_PER_SHARD, check_rows
from tests.faults.power_cut_campaign import call, check_done, make_in_steps, mounted_disk
from tests.made_runs import make_run


@contextmanager
def quota_folder(folder: Path) -> Generator[tuple[Path, Callable[[int], None]]]:
    """A folder, and what sets its quota, in KiB. OSError or CalledProcessError where none can be had."""
    with mounted_disk(folder, ("mkfs.btrfs", "-q")) as disk:
        limited = disk.folder / "limited"
        call("btrfs", "quota", "enable", str(disk.folder))
        call("btrfs", "subvolume", "create", str(limited))
        yield limited, lambda kib: call("btrfs", "qgroup", "limit", f"{kib}K", str(limited))


def fill_quota(folder: Path, limit: Callable[[int], None], whole: Run, shards: int, step_kib: int) -> int:
    """Make the run, and raise its quota wherever it is spent; return how often it was.

    AssertionError where that is not an error of one line, damages the run, or where the finished run is not
    `whole`.
    """
    refused, run = 0, folder / "run"
    for steps in range(1, 1000):
        limit(steps * step_kib)
        try:
            make_in_steps(str(run), os.devnull, shards)
        except InputError as error:
            refused += 1
            assert "Disk quota exceeded. Free disk space or raise the quota" in str(error), error
            assert "\n" not in str(error)
        else:
            if not Run.open(run).missing():
                check_done(run, whole)
                return refused
        if (run / "manifest.json").exists():
            findings = list(check_runs(Run.open(run).storage, Checked()))
            assert all(finding.kind in ("record", "account", "stale") for finding in findings), findings
    raise AssertionError("it has room, and does not end")


def stall_disk(folder: Path, shards: int, stall_s: float) -> dict[str, int]:
    """Let two Ray workers make a run in the folder, whose file system stalls once 20 shards are committed.

    Deadlines are known then, 60 s at least. Returns how the attempts ended. AssertionError where the run then
    is not the undisturbed one.
    """
    run = make_run(folder / "run", n=shards * SAMPLES_PER_SHARD, shards=())
    command = [sys.executable, "-m", "tests.faults.job", run.storage.url, "0.3"]
    with subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.PIPE, text=True) as job:
        while len(run.committed()) <= 20:
            assert job.poll() is None
            time.sleep(0.1)
        call("fsfreeze", "-f", str(folder))
        try:
            time.sleep(stall_s)
        finally:
            call("fsfreeze", "-u", str(folder))
        out, _ = job.communicate(timeout=600)
    assert job.returncode == 0 and json.loads(out)["end"] == "complete", out
    check_rows(run, list(run.commits()))
    return json.loads(out)["outcomes"]

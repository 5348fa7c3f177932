"""A job on an ext4 file system that is shut down at random moments, as by power cuts."""

from __future__ import annotations

import fcntl
import multiprocessing
import os
import struct
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from datagen.cluster.attempt_guard import Meter
from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.in_process_executor import InProcessExecutor
from datagen.cluster.protocol import AttemptResult, JobTotals, StopRequest
from datagen.cluster.run_recorder import RunRecorder
from datagen.cluster.shard_policy import RetryPolicy
from datagen.schemas.checking.check_runs import Checked, check_runs
from datagen.schemas.errors import InputError
from datagen.schemas.jobs import JobRecord, Jobs, JobState, new_job_id
from datagen.schemas.record_files import utc_now
from datagen.schemas.run import Run
from datagen.schemas.sealing import seal, store_record
from datagen.schemas.storage import open_storage
from tests.cluster.simulated import Heard
from tests.faults.counted import SAMPLES_PER_SHARD, CountedRows, count, make_counted
from tests.faults.crash_points_operations import LAYOUT
from tests.made_runs import manifest_of, small_spec

_SHUTDOWN, _NO_LOG_FLUSH = 0x8004587D, 2  # EXT4_IOC_SHUTDOWN of linux/ext4.h, and its flag
_STEPS = 3
_FORKS = multiprocessing.get_context("forkserver")
_FORKS.set_forkserver_preload(["tests.faults.power_cut_campaign"])


def make_durable(task: CountedRows, meter: Meter) -> AttemptResult:
    """Make and commit the shard, and note it once its commit is said to be durable."""
    result = make_counted(replace(task, counted=os.devnull), meter)
    count(task.counted, "committed", str(task.shard))
    return result


def job(folder: str, noted: str, shards: int) -> None:
    """Make the run, or go on with it; `noted` has what must outlive a power cut from then on."""
    count(noted, "begun", "-")
    try:
        make_in_steps(folder, noted, shards)
    except InputError as error:  # the disk is gone
        is_gone = error.problem in ("Input/output error", "Read-only file system")
        sys.exit(2 if is_gone else f"error: {error}")


def make_in_steps(folder: str, noted: str, shards: int) -> None:
    """Make the run in steps, each of which ends with a seal. InputError where the disk fails a record."""
    storage, per_step = open_storage(folder), SAMPLES_PER_SHARD * shards // _STEPS
    run = Run.create_or_open(storage, manifest_of(small_spec(), LAYOUT), per_step)
    jobs, name = Jobs(storage), new_job_id()
    jobs.begin(JobRecord(id=name, command=(), host="", pid=0, started=utc_now(), address="local"))

    def on_tick(totals: JobTotals) -> None:
        jobs.put_state(JobState(id=name, updated=utc_now(), phase="making", done=totals.committed))

    def make_task(order: AttemptOrder) -> CountedRows:
        return CountedRows(folder, noted, 0, False, order.shard, order.attempt, order.deadline_s, "")

    for step in range(1, _STEPS + 1):
        run.grow(step * per_step)
        executor, heard = InProcessExecutor(make_durable), Heard(on_tick=on_tick)
        drive(run.missing(), make_task, executor, RunRecorder(run), RetryPolicy(), heard, StopRequest())
        run.close_lost_attempts()
        seal(storage)
        count(noted, "sealed", "-")


@dataclass(frozen=True)
class Disk:
    """An ext4 file system in a file, on a loop device, mounted at a folder."""

    image: Path
    folder: Path

    def mount(self) -> None:
        call("mount", "-o", "loop,noatime", str(self.image), str(self.folder))

    def unmount(self) -> None:
        call("umount", str(self.folder))

    def cut(self) -> None:
        """Stop the file system at once; what its journal has not on the disk is lost."""
        fd = os.open(self.folder, os.O_RDONLY)
        try:
            fcntl.ioctl(fd, _SHUTDOWN, struct.pack("I", _NO_LOG_FLUSH))
        finally:
            os.close(fd)


@contextmanager
def mounted_disk(folder: Path, make: tuple[str, ...] = ("mkfs.ext4", "-q", "-F")) -> Generator[Disk]:
    """A new disk below the folder, formatted by `make`.

    CalledProcessError or OSError where this machine has none for us.
    """
    disk = Disk(folder / "image", folder / "disk")
    disk.folder.mkdir()
    with disk.image.open("wb") as f:
        f.truncate(512 * 2**20)
    call(*make, str(disk.image))
    disk.mount()
    try:
        yield disk
    finally:
        disk.unmount()


def call(*words: str) -> None:
    """Run a program of the system. CalledProcessError where it fails."""
    subprocess.run(words, check=True, capture_output=True, text=True)


def cut_one(disk: Disk, folder: Path, noted: Path, shards: int, after_s: float) -> None:
    """Let the job work at the run for some seconds, and cut the power."""
    process = start(folder, noted, shards)
    time.sleep(after_s)
    disk.cut()
    process.kill()
    process.join()
    disk.unmount()
    disk.mount()


def start(folder: Path, noted: Path, shards: int) -> Any:
    """Start the job in a process of its own, and wait until it begins."""
    before = noted.read_text().count("begun")
    process = _FORKS.Process(target=job, args=(str(folder), str(noted), shards))
    process.start()
    while noted.read_text().count("begun") == before:
        assert process.is_alive(), "the job does not start"
        time.sleep(0.001)
    return process


def check_cut(folder: Path, noted: Path, counts: Counter[str]) -> None:
    """AssertionError where something durable is lost, or damaged; the rest is counted."""
    notes = [line.split() for line in noted.read_text().splitlines()]
    shards = {int(shard) for word, shard, _ in notes if word == "committed"}
    is_sealed = any(word == "sealed" for word, _, _ in notes)
    counts.update({"cuts": 1, "shards said to be durable": len(shards)})
    if not shards and not (folder / "manifest.json").exists():
        counts["no run yet"] += 1
        return
    run = Run.open(folder)
    assert shards <= run.committed(), f"lost: {sorted(shards - run.committed())}"
    counts["other shards there"] += len(run.committed() - shards)
    for commit in run.commits():
        run.read_object(commit)
    assert store_record(run.storage) is not None or not is_sealed, "the store is lost"
    for finding in check_runs(run.storage, Checked()):
        # What a resume writes: a copy or a start of which the other was first, and the ends of lost attempts.
        is_missing = finding.kind in ("record", "account") and finding.problem.startswith("missing")
        assert is_missing or finding.kind == "stale", finding
        counts["records missing"] += is_missing
    counts["torn job states"] += sum(one.state is None for one in Jobs(run.storage).all())


def check_done(folder: Path, whole: Run) -> None:
    """AssertionError where the finished run is not the undisturbed one, byte by byte."""
    run = Run.open(folder)
    findings = list(check_runs(run.storage, Checked()))
    assert not findings, findings
    for ours, theirs in zip(run.commits(), whole.commits(), strict=True):
        assert run.read_object(ours) == whole.read_object(theirs)
    ours, theirs = store_record(run.storage), store_record(whole.storage)
    assert ours is not None and theirs is not None and ours.files == theirs.files

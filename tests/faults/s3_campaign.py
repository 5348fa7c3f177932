"""Small jobs on an S3 store that fails at random, resumed until they are done, and then looked at closely."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zarr
from obstore.store import S3Store
from zarr.storage import ObjectStore

from datagen.cluster.attempt_guard import Meter
from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.in_process_executor import InProcessExecutor
from datagen.cluster.protocol import AttemptResult, StopRequest
from datagen.cluster.run_recorder import RunRecorder, close_lost_attempts
from datagen.cluster.shard_policy import RetryPolicy
from datagen.schemas.errors import InputError
from datagen.schemas.record_files import commit_copy_key, shard_folder
from datagen.schemas.run import Run
from datagen.schemas.run_records import Layout
from datagen.schemas.sealing import seal
from datagen.schemas.storage import open_storage
from tests.cluster.simulated import Heard
from tests.made_runs import check_digests, make_run, manifest_of, small_spec, write
from tests.s3_servers import Faults

_COUNTS = ("requests", "pass", "commits", "creates")
LAYOUT = Layout(scenes_per_shard=2, candidates_per_scene=5)


@dataclass(frozen=True)
class Rows:
    """A shard of random rows, and the file that counts its executions."""

    run: str
    executions: str
    shard: int
    attempt: str
    deadline_s: float
    notes: str = ""


def make_rows(task: Rows, meter: Meter) -> AttemptResult:
    """Write and commit the shard; a line in the file for each execution that the ledger knows of."""
    run = Run.open(task.run)
    run.ledger.start(task.attempt, task.shard)
    with Path(task.executions).open("a") as f:
        f.write(f"{task.attempt}\n")
    commit = write(run, task.shard, task.attempt).model_copy(update={"cost": meter.cost()})
    return AttemptResult(run.commit(commit), commit.samples, commit.positives, commit.cost)


@dataclass(frozen=True)
class Outcome:
    """What a campaign went through."""

    shards: int
    jobs: int  # how often a job was begun
    executions: int
    requests: int
    faults: Counter[str]


def campaign(address: str, shards: int, faults: Faults, folder: Path) -> Outcome:
    """Make a run of N shards at the address, whose proxy does as `faults` says, and seal it.

    A job that ends with an InputError is begun again, and the store is up again by then. Raises
    AssertionError where the run then is not what an undisturbed one is.
    """
    executions = folder / "executions"
    executions.touch()
    jobs = 0
    while True:
        jobs += 1
        assert jobs < 50, "the store recovers, and still the job does not end"
        try:
            run = _job(address, shards, str(executions))
            if not run.missing():
                seal(run.storage)
                break
        except InputError:
            faults.down = False
    seen = faults.seen.copy()
    # The rest is looking.
    faults.error = faults.lost_answer = faults.hold = faults.cut = 0.0
    faults.lost_creates, faults.down_after, faults.down_at_commits = 0, [], []
    _hold_to_ledger(run, executions.read_text().split())
    _hold_to_an_undisturbed_run(run, shards, folder / "undisturbed")
    counts = Counter({kind: count for kind, count in seen.items() if kind not in _COUNTS})
    lines = len(executions.read_text().split())
    return Outcome(shards, jobs, lines, seen["requests"], counts)


def _job(address: str, shards: int, executions: str) -> Run:
    manifest = manifest_of(small_spec(), LAYOUT)
    run = Run.create_or_open(open_storage(address), manifest, shards * LAYOUT.samples_per_shard)

    def make_task(order: AttemptOrder) -> Rows:
        return Rows(address, executions, order.shard, order.attempt, order.deadline_s)

    policy, executor = RetryPolicy(), InProcessExecutor(make_rows)
    drive(run.missing(), make_task, executor, RunRecorder(run), policy, Heard(), StopRequest())
    close_lost_attempts(run)
    return run


def _hold_to_ledger(run: Run, executions: list[str]) -> None:
    """Every execution is in the ledger once, with an end; every shard was committed once."""
    assert len(executions) == len(set(executions))
    assert not run.quarantined() and not run.missing()
    commits = {commit.attempt: commit for commit in run.commits()}
    assert [commit.shard for commit in commits.values()] == list(run.planned())
    ends = {entry.attempt: entry for entry in run.ledger.ends()}
    starts = {f.key.split("/")[1].removesuffix(".start.json") for f in run.storage.list("ledger")} - {
        f"{attempt}.json" for attempt in ends
    }
    assert set(executions) <= starts <= ends.keys()
    committed = {attempt for attempt, entry in ends.items() if entry.outcome == "committed"}
    assert committed == commits.keys()
    for attempt, commit in commits.items():
        assert ends[attempt].cost == commit.cost


def _hold_to_an_undisturbed_run(run: Run, shards: int, folder: Path) -> None:
    """Committed files and the sealed store are, bit by bit, those of a local run that nothing befell."""
    other = make_run(folder, shards * LAYOUT.samples_per_shard, 2, 5)
    for ours, theirs in zip(run.commits(), other.commits(), strict=True):
        assert [(e.path, e.sha256) for e in ours.files] == [(e.path, e.sha256) for e in theirs.files]
        check_digests(run, ours)
        key = commit_copy_key(ours.shard, ours.attempt)
        copy = run.storage.get(key, 2**24)
        assert copy == run.storage.get(f"commits/{ours.shard:06d}.json", 2**24)
        whole = shard_folder(ours.shard, ours.attempt)
        there = {f.key.removeprefix(f"{whole}/") for f in run.storage.list(whole)}
        assert there == {e.path for e in ours.files} | {"commit.json"}
    seal(other.storage)
    ours, theirs = sealed_arrays(run), zarr.open_group(folder / "data.zarr", mode="r")
    assert ours.keys() == set(theirs.array_keys())
    for name, values in ours.items():
        np.testing.assert_array_equal(values, np.asarray(theirs[name][...]), err_msg=name)


def sealed_arrays(run: Run) -> dict[str, np.ndarray]:
    """Every array of a sealed run on S3, read by zarr alone."""
    bucket, _, prefix = run.storage.url.removeprefix("s3://").partition("/")
    options = {"allow_http": True}
    store = ObjectStore(S3Store(bucket, prefix=f"{prefix}/data.zarr", client_options=options), read_only=True)
    group = zarr.open_group(store, mode="r")
    return {name: np.asarray(array[...]) for name, array in group.arrays()}

"""Small jobs on an S3 store that fails at random, resumed until they are done, and then looked at closely."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.in_process_executor import InProcessExecutor
from datagen.cluster.protocol import StopRequest
from datagen.cluster.run_recorder import RunRecorder
from datagen.cluster.shard_policy import RetryPolicy
from datagen.schemas.checking.check_runs import Checked, check_runs
from datagen.schemas.errors import InputError
from datagen.schemas.record_files import is_guess
from datagen.schemas.run import Run
from datagen.schemas.run_records import FileEntry, Layout
from datagen.schemas.sealing import seal, store_record
from datagen.schemas.storage import open_storage
from tests.cluster.simulated import Heard
from tests.faults.counted import CountedRows, executions, make_counted
from tests.made_runs import make_run, manifest_of, small_spec
from tests.s3_servers import Faults

_COUNTS = ("requests", "pass", "commits", "creates")
LAYOUT = Layout(scenes_per_shard=2, candidates_per_scene=5)


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
    counted = folder / "executions"
    counted.touch()
    jobs = 0
    while True:
        jobs += 1
        assert jobs < 50, "the store recovers, and still the job does not end"
        try:
            run = _job(address, shards, str(counted))
            if not run.missing():
                seal(run.storage)
                break
        except InputError:
            faults.down = False
    seen = faults.seen.copy()
    # The rest is looking.
    faults.error = faults.lost_answer = faults.hold = faults.cut = 0.0
    faults.lost_creates, faults.down_after, faults.down_at_commits = 0, [], []
    begun = executions(counted).begun
    check_ledger(run, begun)
    check_undisturbed(run, shards, folder / "undisturbed")
    counts = Counter({kind: count for kind, count in seen.items() if kind not in _COUNTS})
    return Outcome(shards, jobs, len(begun), seen["requests"], counts)


def _job(address: str, shards: int, counted: str) -> Run:
    manifest = manifest_of(small_spec(), LAYOUT)
    run = Run.create_or_open(open_storage(address), manifest, shards * LAYOUT.samples_per_shard)

    def make_task(order: AttemptOrder) -> CountedRows:
        return CountedRows(address, counted, 0, False, order.shard, order.attempt, order.deadline_s, "")

    policy, executor = RetryPolicy(), InProcessExecutor(make_counted)
    drive(run.missing(), make_task, executor, RunRecorder(run), policy, Heard(), StopRequest())
    run.close_lost_attempts()
    return run


def check_ledger(run: Run, begun: set[str]) -> None:
    """Every execution is in the ledger once, with a commit or an end; every shard was committed once."""
    assert not run.quarantined() and not run.missing()
    commits = {commit.attempt: commit for commit in run.commits()}
    assert [commit.shard for commit in commits.values()] == list(run.planned())
    ends = {entry.attempt: entry for entry in run.ledger.ends()}
    keys = {file.key.removeprefix("ledger/") for file in run.storage.list("ledger")}
    starts = {key.removesuffix(".start.json") for key in keys if key.endswith(".start.json")}
    assert begun <= starts == ends.keys() | commits.keys()
    assert all(is_guess(ends[attempt]) for attempt in ends.keys() & commits.keys())


def check_undisturbed(run: Run, shards: int, folder: Path) -> None:
    """Committed objects and the sealed store are, bit by bit, those of a local run that nothing befell."""
    other = make_run(folder, shards * LAYOUT.samples_per_shard, 2, 5)
    for ours, theirs in zip(run.commits(), other.commits(), strict=True):
        assert run.read_object(ours) == other.read_object(theirs)
    seal(other.storage)
    record, undisturbed = store_record(run.storage), store_record(other.storage)
    assert record is not None and undisturbed is not None and record.files == undisturbed.files
    for entry in record.files:
        data = run.storage.get(f"{record.name}/{entry.path}", entry.size)
        assert data is not None and FileEntry.of(entry.path, data) == entry
    assert not list(check_runs(run.storage, Checked()))

"""Jobs whose every execution is counted by a file of its own, for campaigns that kill workers and drivers."""

from __future__ import annotations

import multiprocessing
import os
import random
import tempfile
import time
from collections import Counter
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import fsum, isclose
from pathlib import Path
from typing import Any

from datagen.cluster.attempt_guard import Meter, this_host
from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.protocol import AttemptResult, StopRequest
from datagen.cluster.run_recorder import RunRecorder
from datagen.cluster.shard_policy import OpenShards, RetryPolicy
from datagen.reports.audit import account_for
from datagen.schemas.record_files import commit_key
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit, StageClock
from datagen.schemas.sealing import seal
from tests.cluster.simulated import Heard
from tests.faults.processes import ProcessExecutor
from tests.made_runs import make_run, write
from tests.small_runs import arrays_of, assert_equal_runs

# Whoever is killed again and again must not give a shard up.
PATIENT = RetryPolicy(
    max_failures=1000, max_lost=1000, backoff_s=0.02, max_backoff_s=0.1, initial_deadline_s=120, look_s=0.5
)
SAMPLES_PER_SHARD = 10

# Drivers are forked from a process that has loaded everything and done nothing.
_FORKS = multiprocessing.get_context("forkserver")
_FORKS.set_forkserver_preload(["tests.faults.counted"])


@contextmanager
def memory_folder() -> Generator[Path]:
    """A folder in memory where there is one: what becomes of killed processes does not ask for a disk."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None) as folder:
        yield Path(folder)


@dataclass(frozen=True)
class CountedRows:
    """A shard of random rows that takes its time, and leaves a line in `counted` when it begins."""

    run: str
    counted: str
    seconds: float
    stubborn: bool
    shard: int
    attempt: str
    deadline_s: float
    notes: str


def count(counted: str, word: str, attempt: str) -> None:
    """Append a line to the file, in one write: it is there whole or not at all, whoever else appends."""
    fd = os.open(counted, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        os.write(fd, f"{word} {attempt} {os.getpid()}\n".encode())
    finally:
        os.close(fd)


def make_counted(task: CountedRows, meter: Meter) -> AttemptResult:
    """Draw, write and commit the shard, as `datagen.cluster.attempt` does with real ones."""
    run, clock = Run.open(task.run), StageClock()
    count(task.counted, "begins", task.attempt)
    run.ledger.start(task.attempt, task.shard)
    count(task.counted, "begun", task.attempt)
    if not task.stubborn and run.storage.exists(commit_key(task.shard)):
        return AttemptResult(False, 0, 0, meter.cost())
    with clock.stage("draw"):
        time.sleep(task.seconds * random.uniform(0.5, 1.5))
    with clock.stage("write"):
        commit = write(run, task.shard, task.attempt)
    cost = meter.cost(clock, written_bytes=commit.object.size)
    won = run.commit(commit.model_copy(update={"cost": cost, "host": this_host()}))
    return AttemptResult(won, commit.samples, commit.positives, cost)


def drive_counted(
    place: str, counted: str, seconds: float, workers: int, stubborn: bool = False, together: Any = None
) -> None:
    """A driver's life: the missing shards of the run. With `stubborn` it does not heed other drivers.

    `together` is a barrier of all that begin at once: a busy machine may start one long after another.
    """
    run = Run.open(place)
    if stubborn:
        OpenShards.go_elsewhere = lambda self: None
        OpenShards.keep = lambda self, missing: 0
    notes = f"{counted}-notes-{os.getpid()}"  # a killed driver leaves them behind

    def make_task(order: AttemptOrder) -> CountedRows:
        return CountedRows(
            place, counted, seconds, stubborn, order.shard, order.attempt, order.deadline_s, notes
        )

    executor = ProcessExecutor(make_counted, workers)
    if together is not None:
        together.wait(300)
    drive(run.missing(), make_task, executor, RunRecorder(run), PATIENT, Heard(), StopRequest())
    executor.close()
    run.close_lost_attempts()


def start_driver(
    run: Run, counted: Path, seconds: float, workers: int, stubborn: bool = False, together: Any = None
) -> Any:
    """A driver in a process of its own."""
    arguments = (run.storage.url, str(counted), seconds, workers, stubborn, together)
    process = _FORKS.Process(target=drive_counted, args=arguments)
    process.start()
    return process


def all_at_once(drivers: int) -> Any:
    """What drivers wait at until N are ready."""
    return _FORKS.Barrier(drivers)


@dataclass(frozen=True)
class Executions:
    """What the file of executions says: attempts by how far they came at least, and all processes."""

    begins: set[str]
    begun: set[str]
    processes: set[int]


def executions(counted: Path) -> Executions:
    """Read the file of executions; an attempt that is in it twice fails."""
    rows = [line.split() for line in counted.read_text().splitlines()]
    times = Counter((word, attempt) for word, attempt, _ in rows)
    assert max(times.values(), default=1) == 1, "two executions had one name"
    names = {word: {attempt for w, attempt, _ in rows if w == word} for word in ("begins", "begun")}
    return Executions(names["begins"], names["begun"], {int(pid) for _, _, pid in rows})


def await_ends(counted: Path, within_s: float = 300.0) -> None:
    """Wait until no worker is left: those of a killed driver finish what they are at."""
    until_s = time.monotonic() + within_s
    while any(_is_worker(pid) for pid in executions(counted).processes):
        assert time.monotonic() < until_s, "a worker does not end"
        time.sleep(0.02)


def _is_worker(pid: int) -> bool:
    try:
        return b"forkserver" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return False


def check_rows(run: Run, commits: Sequence[Commit]) -> None:
    """AssertionError where a finished run is not, in objects and store, the uninterrupted one."""
    committed = {commit.attempt for commit in commits}
    assert [commit.shard for commit in commits] == list(run.planned()) and len(committed) == len(commits)
    assert not run.quarantined() and not run.ledger.unfinished(committed)
    folder = Path(run.storage.url)
    reference = make_run(folder.parent / f"{folder.name}-uninterrupted", n=run.n)
    for ours, theirs in zip(commits, reference.commits(), strict=True):
        assert run.read_object(ours) == reference.read_object(theirs)
    seal(reference.storage)
    seal(run.storage)
    assert_equal_runs(arrays_of(folder), arrays_of(Path(reference.storage.url)))


def check_run(run: Run, counted: Path, kills: int = 0) -> dict[str, float]:
    """Hold a finished run against an uninterrupted one, and its ledger against the executions.

    `kills` is how many workers and drivers were killed. Returns what a report shows. AssertionError names
    what does not agree.
    """
    run = Run.open(run.storage.url)
    shards = len(run.planned())
    folder, commits = Path(run.storage.url), list(run.commits())
    check_rows(run, commits)
    starts = {file.name.removesuffix(".start.json") for file in folder.glob("ledger/*.start.json")}
    ends = {end.attempt: end for end in run.ledger.ends()}
    seen = executions(counted)
    # A kill between the two lines of a beginning leaves the record of the start, or does not. One before
    # the first line leaves no execution, and the driver's account of an attempt that came to nothing.
    unseen = starts - seen.begins
    assert seen.begun <= starts, f"executions without a start: {seen.begun - starts}"
    winners = {commit.attempt for commit in commits}
    assert starts == set(ends) | winners, "an attempt has no end"
    odd = {name: ends[name].outcome for name in unseen if ends[name].outcome != "crashed"}
    assert not odd, f"starts without an execution: {odd}"
    assert len(unseen) <= kills, f"{len(unseen)} starts without an execution of {kills} kills"

    assert all(0 < fsum(commit.cost.stage_wall_s.values()) <= commit.cost.wall_s for commit in commits)
    paid_s = [commit.cost.wall_s for commit in commits]
    # A commit outweighs the guess that its attempt was lost.
    waste_s = [end.cost.wall_s for name, end in ends.items() if name not in winners and end.cost]

    recorder = account_for([run])
    waste = sum(account.attempts for account in recorder.waste.values())
    assert recorder.useful.attempts == shards and recorder.contradictions == 0
    assert recorder.useful.attempts + waste == len(starts)
    total_s = recorder.useful.wall_s + recorder.wasted.wall_s
    assert isclose(total_s, fsum(paid_s + waste_s), rel_tol=1e-9)
    return {
        "shards": shards,
        "executions": len(seen.begun),
        "cut at their beginning": len(seen.begins - seen.begun),
        "killed before it": len(unseen),
        "attempts wasted": waste,
        "of these without account": recorder.wasted.unknown,
        "waste share of time": recorder.wasted.wall_s / total_s,
    } | {f"ended {outcome}": recorder.waste[outcome].attempts for outcome in sorted(recorder.waste)}

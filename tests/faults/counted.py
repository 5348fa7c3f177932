"""Jobs whose every execution is counted by a file of its own, for campaigns that kill workers and drivers."""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import tempfile
import time
from collections import Counter
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from math import fsum, isclose
from pathlib import Path
from typing import Any

from datagen.cluster.attempt_guard import Meter, this_host
from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.protocol import AttemptResult, StopRequest
from datagen.cluster.run_recorder import RunRecorder, close_lost_attempts
from datagen.cluster.shard_policy import OpenShards, RetryPolicy
from datagen.reports.spending import account_for
from datagen.schemas.record_files import commit_key
from datagen.schemas.run import Run
from datagen.schemas.run_records import StageClock
from datagen.schemas.sealing import seal
from datagen.schemas.shard_files import encode_shard
from tests.cluster.simulated import Heard
from tests.faults.processes import ProcessExecutor
from tests.made_runs import check_digests, commit_of, make_run, rows_of
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
        scenes, samples = rows_of(run, task.shard)
    with clock.stage("write"):
        files = encode_shard(run.schema, run.layout, run.manifest.spec_hash, scenes, samples)
        entries = run.write_shard(task.shard, task.attempt, files)
    cost = meter.cost(clock, written_bytes=sum(entry.size for entry in entries))
    commit = commit_of(run, task.shard, task.attempt, entries, int(samples["label"].sum()))
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
    close_lost_attempts(run)


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


def check_run(run: Run, counted: Path, kills: int = 0) -> dict[str, float]:
    """Hold a finished run against an uninterrupted one, and its ledger against the executions.

    `kills` is how many workers and drivers were killed. Returns what a report shows. AssertionError names
    what does not agree.
    """
    run = Run.open(run.storage.url)
    shards = len(run.planned())
    assert run.missing() == [] and run.quarantined() == set() and run.ledger.unfinished() == []
    folder = Path(run.storage.url)
    reference = make_run(folder.parent / f"{folder.name}-uninterrupted", n=run.n)
    seal(reference.storage)
    seal(run.storage)
    assert_equal_runs(arrays_of(folder), arrays_of(Path(reference.storage.url)))

    ledger = {file.stem: json.loads(file.read_bytes()) for file in folder.glob("ledger/*.json")}
    starts = {name.removesuffix(".start") for name in ledger if name.endswith(".start")}
    ends = {name: entry for name, entry in ledger.items() if not name.endswith(".start")}
    seen = executions(counted)
    # A kill between the two lines of a beginning leaves the record of the start, or does not. One before
    # the first line leaves no execution, and the driver's account of an attempt that came to nothing.
    unseen = starts - seen.begins
    assert seen.begun <= starts, f"executions without a start: {seen.begun - starts}"
    assert starts <= set(ends), "an attempt has no end"
    odd = {name: ends[name]["outcome"] for name in unseen if ends[name]["outcome"] != "crashed"}
    assert not odd, f"starts without an execution: {odd}"
    assert len(unseen) <= kills, f"{len(unseen)} starts without an execution of {kills} kills"

    winners: set[str] = set()
    wall_s: list[float] = []
    for shard in range(shards):
        check_digests(run, run.commit_of(shard))
        commit = json.loads((folder / commit_key(shard)).read_bytes())
        winners.add(commit["attempt"])
        wall_s.append(commit["cost"]["wall_s"])
        named_s = fsum(commit["cost"]["stage_wall_s"].values())
        assert 0 < named_s <= commit["cost"]["wall_s"]
    assert len(winners) == shards and winners <= starts
    assert winners == {name for name, end in ends.items() if end["outcome"] == "committed"}
    lost_s = [end["cost"]["wall_s"] for name, end in ends.items() if name not in winners and end["cost"]]

    recorder = account_for([run])
    waste = sum(account.attempts for account in recorder.waste.values())
    assert recorder.useful.attempts == shards and recorder.contradictions == 0
    assert recorder.useful.attempts + waste == len(ends) == len(set(ends) | starts)
    total_s = recorder.useful.wall_s + recorder.wasted.wall_s
    assert isclose(total_s, fsum(wall_s + lost_s), rel_tol=1e-9)
    assert set(recorder.difference_s.values()) == {0.0}
    return {
        "shards": shards,
        "executions": len(seen.begun),
        "cut at their beginning": len(seen.begins - seen.begun),
        "killed before it": len(unseen),
        "attempts wasted": waste,
        "of these without account": recorder.wasted.unknown,
        "waste share of time": recorder.wasted.wall_s / total_s,
    } | {f"ended {outcome}": recorder.waste[outcome].attempts for outcome in sorted(recorder.waste)}

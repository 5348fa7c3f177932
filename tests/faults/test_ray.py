"""Real Ray workers that crash, hang and die: each ending is seen for what it is, others go on."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.protocol import JobSummary, JobTotals, StopRequest
from datagen.cluster.ray_cluster import RaySettings, ray_cluster
from datagen.cluster.ray_executor import RayExecutor
from datagen.cluster.shard_policy import RetryPolicy
from tests.cluster.simulated import Heard, PaperRecorder
from tests.faults.scripted import ScriptedTask, perform

pytestmark = pytest.mark.slow

SETTINGS = RaySettings(workers=2, attempts_per_worker=50)
POLICY = RetryPolicy(max_quarantined_share=1.0, backoff_s=0.05, initial_deadline_s=60)


@pytest.fixture(scope="module")
def ray(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """One local cluster of two slots, started from a folder that is not the repository."""
    before = Path.cwd()
    os.chdir(tmp_path_factory.mktemp("elsewhere"))
    try:
        with ray_cluster(SETTINGS) as ray:
            yield ray
    finally:
        os.chdir(before)


@dataclass
class Played:
    summary: JobSummary
    recorder: PaperRecorder
    folder: Path

    def ends(self, shard: int) -> list[str]:
        return [e.outcome for e in self.recorder.entries if e.shard == shard]

    def entry(self, outcome: str) -> Any:
        return next(e for e in self.recorder.entries if e.outcome == outcome)


def play(
    ray: Any,
    folder: Path,
    words: Mapping[int, tuple[str, ...]],
    shards: int = 6,
    policy: RetryPolicy = POLICY,
    deadline_s: float = 30.0,
    on_tick: Callable[[JobTotals, StopRequest], None] = lambda totals, stop: None,
) -> Played:
    notes = folder / "notes"
    notes.mkdir()

    def make_task(order: AttemptOrder) -> ScriptedTask:
        return ScriptedTask(
            order.shard,
            order.attempt,
            deadline_s,
            str(notes),
            words.get(order.shard, ()),
        )

    stop, recorder = StopRequest(), PaperRecorder()
    heard = Heard(on_tick=lambda totals: on_tick(totals, stop))
    executor = RayExecutor(perform, SETTINGS, ray)
    summary = drive(range(shards), make_task, executor, recorder, policy, heard, stop)
    assert list(notes.iterdir()) == []  # neither notes nor stacks are left behind
    return Played(summary, recorder, folder)


def test_a_job_takes_no_more_slots_of_a_cluster_than_it_was_given(ray: Any) -> None:
    free = RayExecutor(perform, replace(SETTINGS, address="auto", workers=None), ray).slots
    assert free > 1
    assert RayExecutor(perform, replace(SETTINGS, address="auto", workers=1), ray).slots == 1
    assert RayExecutor(perform, replace(SETTINGS, address="auto", workers=free + 9), ray).slots == free


@dataclass(frozen=True)
class Fate:
    """How an attempt that does `words[0]` first must stand in the ledger, and how the shard ends."""

    words: tuple[str, ...]
    outcomes: list[str]
    cause: str  # a pattern for the first attempt's cause
    stack: str = ""  # what the first attempt's stack names; "" where there can be none
    given_up: bool = False


DIED = "the worker process died"
FATES = {
    # Killed from within or without: where native code fails, its stack is there.
    "segfault": Fate(("segfault",), ["crashed", "committed"], "Fatal Python error: Segm", "misbehave"),
    "abort": Fate(("abort",), ["crashed", "committed"], "Fatal Python error: Aborted", "misbehave"),
    "kill": Fate(("kill",), ["crashed", "committed"], rf"{DIED} \(killed, as by .* lack of memory"),
    # Ends without a word, be its status good or bad.
    "silent exit": Fate(("silent_exit",), ["crashed", "committed"], DIED),
    "exit": Fate(("exit",), ["crashed", "committed"], DIED),
    "SystemExit": Fate(("system_exit",), ["crashed", "committed"], DIED),
    # Fails and says so.
    "exception": Fate(("raise",), ["failed", "committed"], "ValueError: a scene of two lines", "misbehave"),
    "NaN": Fate(
        ("not_finite",), ["failed", "committed"], "InputError: .*visibility: has NaN", "hand_over_bad"
    ),
    "shape": Fate(("one_row_less",), ["failed", "committed"], r"InputError: .*shape \(9,\)", "hand_over_bad"),
    # Memory.
    "MemoryError": Fate(("memory",), ["out_of_memory", "committed"], "MemoryError", "misbehave"),
    "limit": Fate(("memory_limit",), ["out_of_memory", "committed"], "MemoryError", "misbehave"),
    # Each has a budget of its own: three failures of any kind, two out of memory, and they do not add up.
    "failures": Fate(("segfault", "raise", "kill"), ["crashed", "failed", "crashed"], "Fatal", given_up=True),
    "memory twice": Fate(("memory",) * 2, ["out_of_memory"] * 2, "MemoryError", given_up=True),
    "mixed": Fate(
        ("raise", "memory", "kill"), ["failed", "out_of_memory", "crashed", "committed"], "ValueError"
    ),
}


def test_every_way_to_die_has_its_outcome_its_cause_its_stack_and_its_budget(
    ray: Any, tmp_path: Path
) -> None:
    words = {shard: fate.words for shard, fate in enumerate(FATES.values())}
    played = play(ray, tmp_path, words, shards=len(FATES) + 4)
    assert played.summary.totals.committed == 4 + sum(not fate.given_up for fate in FATES.values())
    for shard, (name, fate) in enumerate(FATES.items()):
        first = next(e for e in played.recorder.entries if e.shard == shard)
        assert played.ends(shard) == fate.outcomes, name
        assert re.match(fate.cause, first.cause), f"{name}: {first.cause}"
        assert fate.stack in first.stack and bool(first.stack) >= bool(fate.stack), name
        assert first.host is not None and first.host.pid > 0 and first.cost.wall_s >= 0, name
        assert (shard in played.recorder.given_up) == fate.given_up, name
    committed = played.entry("committed")
    assert committed.cost.peak_rss_bytes > 10 << 20 and committed.started <= committed.ended


class KillsItsReader:
    """Becomes a word of a script where it is read, but for the first reader, which it kills."""

    def __init__(self, seen: Path) -> None:
        self._seen = seen

    def __reduce__(self) -> tuple[Any, ...]:
        return die_once, (self._seen,)


def die_once(seen: Path) -> str:
    if not seen.exists():
        seen.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "commit"


def test_a_worker_that_dies_before_an_attempt_begins_is_no_fault_of_the_shard(
    ray: Any, tmp_path: Path
) -> None:
    played = play(ray, tmp_path, {1: (KillsItsReader(tmp_path / "seen"),)}, shards=3)  # type: ignore[dict-item]
    assert played.summary.totals.committed == 3 and played.ends(1) == ["lost", "committed"]
    lost = played.entry("lost")
    assert lost.cause == "its worker died before it began or after it ended, or with its machine"
    assert lost.host is None and lost.cost is None


def test_hangs_end_at_their_deadline_with_the_stack(ray: Any, tmp_path: Path) -> None:
    played = play(ray, tmp_path, {0: ("hang",), 1: ("hang_with_lock",)}, shards=4, deadline_s=5.0)
    assert played.summary.totals.committed == 4
    for shard in (0, 1):
        assert played.ends(shard) == ["hung", "committed"]
        entry = next(e for e in played.recorder.entries if e.shard == shard)
        assert "deadline of 5 s" in entry.cause and "misbehave" in entry.stack
        assert entry.cost is not None and entry.cost.wall_s >= 5.0


def test_a_process_that_cannot_end_itself_is_ended_by_the_driver(ray: Any, tmp_path: Path) -> None:
    policy = RetryPolicy(max_quarantined_share=1.0, initial_deadline_s=5.0, grace_s=0.5, backoff_s=0.05)
    played = play(ray, tmp_path, {1: ("stop",)}, shards=3, policy=policy)
    assert played.summary.totals.committed == 3 and played.ends(1) == ["hung", "committed"]
    assert "ended by the driver" in played.entry("hung").cause


def test_a_shard_that_always_crashes_is_given_up_with_its_stacks(ray: Any, tmp_path: Path) -> None:
    played = play(ray, tmp_path, {1: ("segfault",) * 3}, shards=3)
    trouble = played.recorder.given_up[1]
    assert played.summary.totals.committed == 2 and len(trouble.stacks) == 3
    assert all("Segmentation fault" in stack for stack in trouble.stacks)


def test_a_full_disk_ends_the_job(ray: Any, tmp_path: Path) -> None:
    played = play(ray, tmp_path, dict.fromkeys(range(0, 400, 5), ("disk",)), shards=400)
    assert played.summary.end == "aborted" and played.summary.totals.committed < 50
    assert played.summary.cause == "RUN: No space left on device. Free disk space"


def test_a_forced_stop_ends_hung_workers_and_frees_their_slots(ray: Any, tmp_path: Path) -> None:
    def stop_when_running(totals: JobTotals, stop: StopRequest) -> None:
        if len(list((tmp_path / "notes").glob("*.stack"))) == 2:
            stop.ask()
            stop.ask()

    # Ray may still give an attempt to a worker that another test has killed; these find it.
    (tmp_path / "before").mkdir()
    assert play(ray, tmp_path / "before", {}, shards=6).summary.totals.committed == 6
    words = dict.fromkeys(range(6), ("hang_with_lock",))
    played = play(ray, tmp_path, words, shards=6, on_tick=stop_when_running)
    assert played.summary.end == "interrupted" and played.summary.totals.outcomes == {"cancelled": 4}
    (tmp_path / "after").mkdir()
    assert play(ray, tmp_path / "after", {}, shards=6).summary.totals.committed == 6


def test_a_worker_that_stays_small_is_used_again(ray: Any, tmp_path: Path) -> None:
    attempts = 20
    assert play(ray, tmp_path, {}, shards=attempts).summary.totals.committed == attempts
    pids = [path.name.split("-")[2] for path in (tmp_path / "tries").iterdir()]
    assert len(set(pids)) < len(pids) == attempts

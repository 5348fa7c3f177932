"""The guard and the in-process executor, with real tasks and a real run's recorder."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from datagen.cluster.attempt_guard import Meter, Note, failure_report, guarded, read_note
from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.in_process_executor import InProcessExecutor
from datagen.cluster.protocol import (
    AttemptResult,
    JobCannotContinue,
    JobSummary,
    StopRequest,
    stop_on_signals,
)
from datagen.cluster.run_recorder import RunRecorder
from datagen.cluster.shard_policy import RetryPolicy
from datagen.schemas.run import Run
from tests.cluster.simulated import Heard
from tests.faults.scripted import ScriptedTask, perform
from tests.made_runs import make_run, write
from tests.other_user import NOBODY, needs_root

POLICY = RetryPolicy(max_quarantined_share=0.2, backoff_s=0.01)
Script = dict[int, tuple[str, ...]]


def play(
    run: Run, task: Callable[[ScriptedTask, Meter], AttemptResult], stop: StopRequest, script: Script
) -> JobSummary:
    """Drive the run's missing shards in this process."""
    notes = Path(run.storage.url).with_name("notes")
    notes.mkdir()

    def make_task(order: AttemptOrder) -> ScriptedTask:
        return ScriptedTask(order.shard, order.attempt, 60, str(notes), script.get(order.shard, ()))

    executor = InProcessExecutor(task)
    return drive(run.missing(), make_task, executor, RunRecorder(run), POLICY, Heard(), stop)


def test_a_job_on_a_real_run_leaves_commits_ledger_and_quarantine(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", shards=())

    def commit_after(task: ScriptedTask, meter: Meter) -> AttemptResult:
        """What the script lets pass writes and commits random rows."""
        run.ledger.start(task.attempt, task.shard)
        product = perform(task, meter)
        commit = write(run, task.shard, task.attempt).model_copy(update={"cost": product.cost})
        return AttemptResult(run.commit(commit), commit.samples, commit.positives, product.cost)

    script: Script = {1: ("raise",), 3: ("raise",) * 3, 2: ("memory",)}
    summary = play(run, commit_after, StopRequest(), script)
    assert run.committed() == {0, 1, 2, 4} and run.quarantined() == {3} and run.missing() == []
    record = run.quarantine_records()[0]
    assert record.first_scene == 6 and record.scenes == 2 and len(record.stacks) == 3
    assert all("misbehave" in stack for stack in record.stacks)
    ledger = list(run.ledger.ends())
    assert sorted(e.outcome for e in ledger) == ["failed"] * 4 + ["out_of_memory"]
    assert run.ledger.unfinished({c.attempt for c in run.commits()}) == [] and summary.end == "complete"
    # The account closes: commits are useful, the ledger is waste.
    assert summary.totals.wasted_wall_s == pytest.approx(sum(e.cost.wall_s for e in ledger if e.cost))
    assert summary.totals.useful_wall_s == pytest.approx(sum(c.cost.wall_s for c in run.commits()))


def test_the_second_interrupt_breaks_into_the_running_shard(tmp_path: Path) -> None:
    begun: list[str] = []

    def interrupt_itself(task: ScriptedTask, meter: Meter) -> AttemptResult:
        begun.append(task.attempt)
        for _ in range(2 if len(begun) == 2 else 0):
            os.kill(os.getpid(), signal.SIGINT)
        return AttemptResult(True, 1, 1, meter.cost())

    run = make_run(tmp_path / "run", shards=())
    before = signal.getsignal(signal.SIGINT)
    with stop_on_signals(StopRequest(), interrupt=True) as stop:
        summary = play(run, interrupt_itself, stop, {})
    assert summary.end == "interrupted" and summary.totals.outcomes == {"committed": 1, "cancelled": 2}
    assert signal.getsignal(signal.SIGINT) is before


def test_the_guard_reports_and_leaves_nothing_behind(tmp_path: Path) -> None:
    notes = tmp_path / "notes"
    notes.mkdir()
    seen: list[object] = []

    def look(task: ScriptedTask, meter: Meter) -> AttemptResult:
        seen.append(read_note(task.notes, task.attempt))
        raise JobCannotContinue("RUN: the disk\nis full")

    report = guarded(look, ScriptedTask(7, "a", 60, str(notes)), deadline=False)
    assert report.ends_job and report.outcome == "failed" and report.cause == "RUN: the disk is full"
    (note,) = seen
    assert isinstance(note, Note) and note.host is not None and note.host.pid == os.getpid()
    assert list(notes.iterdir()) == []
    gone = failure_report(ScriptedTask(7, "b", 60, str(notes)), "lost", "node gone")
    assert (gone.outcome, gone.cause, gone.cost, gone.started) == ("lost", "node gone", None, "")
    text = "ImportError: no module\n" + "a long story\n" * 100
    long = failure_report(ScriptedTask(7, "c", 60, str(notes)), "failed", text)
    assert long.stack == text and len(long.cause) == 300 and "\n" not in long.cause


@needs_root
@pytest.mark.parametrize("kind", ["folder", "link"])
def test_notes_are_not_written_where_another_user_could_have_planted_links(tmp_path: Path, kind: str) -> None:
    notes, target = tmp_path / "notes", tmp_path / "target"
    target.mkdir()
    if kind == "link":
        notes.symlink_to(target)
    else:
        notes.mkdir()
        os.chown(notes, NOBODY, NOBODY)
    task = ScriptedTask(7, "a", 60, str(notes))
    report = guarded(lambda *_: pytest.fail("was run"), task, deadline=False)
    assert report.ends_job and "belongs to another user" in report.cause
    assert not list(target.iterdir()) and not list(notes.iterdir())

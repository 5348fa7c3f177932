"""Progress within a shard: what a worker notes, what the display makes of it, and what is left behind."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from datagen.cluster.attempt_guard import (
    Meter,
    beat_path,
    beating,
    collect_post_mortem,
    guarded,
    running_attempts,
)
from datagen.cluster.job_monitor import JobProgress
from datagen.cluster.protocol import AttemptResult, JobTotals
from datagen.display.progress import Progress
from datagen.workers.watched_clock import WatchedClock, count_label
from tests.cluster.simulated import FakeClock
from tests.faults.scripted import ScriptedTask


def task_in(folder: Path, attempt: str = "000000-x-000001") -> ScriptedTask:
    return ScriptedTask(0, attempt, 60.0, str(folder))


def test_an_attempt_shows_its_progress_while_it_runs_and_leaves_no_file(tmp_path: Path) -> None:
    notes, seen = tmp_path / "notes", list[tuple[int, int]]()

    def work(task: ScriptedTask, meter: Meter) -> AttemptResult:
        assert meter.watch is not None
        clock = WatchedClock()
        clock.watch = meter.watch
        for stage in ("grasps", "plan", "plan"):
            with clock.stage(stage):
                running = running_attempts(str(notes))
                seen.append((running.labels, running.in_grasps))
            count_label(clock)
        return AttemptResult(True, 3, 1, meter.cost(clock))

    assert guarded(work, task_in(notes), deadline=False).outcome == "committed"
    assert seen == [(0, 1), (1, 0), (2, 0)]
    assert list(notes.iterdir()) == []


def test_progress_that_cannot_be_noted_costs_no_attempt(tmp_path: Path) -> None:
    def work(task: ScriptedTask, meter: Meter) -> AttemptResult:
        assert meter.watch is not None
        meter.watch("plan", 1)
        return AttemptResult(True, 3, 1, meter.cost())

    task = task_in(tmp_path / "notes")
    (tmp_path / "notes").mkdir(mode=0o700)
    beat_path(tmp_path / "notes", task.attempt).mkdir()
    assert guarded(work, task, deadline=False).outcome == "committed"


def test_the_progress_of_a_dead_worker_is_removed_with_its_note(tmp_path: Path) -> None:
    path = beat_path(tmp_path, "a")
    with beating(path) as watch:
        watch("plan", 5)
        left = path.read_bytes()
    path.write_bytes(left)  # as after SIGKILL
    assert running_attempts(str(tmp_path)).labels == 5
    collect_post_mortem(str(tmp_path), "a")
    assert running_attempts(str(tmp_path)).labels == 0 and not path.exists()


@pytest.mark.parametrize("content", [b"", b"short", b"\xff" * 4096])
def test_a_torn_file_shows_nothing(content: bytes, tmp_path: Path) -> None:
    beat_path(tmp_path, "a").write_bytes(content)
    assert running_attempts(str(tmp_path)).labels == 0


def show(folder: Path, as_json: bool) -> list[str]:
    """A job of ten shards of 60 labels: its first 20 s, in grasps, and 20 s with 40 labels in two shards."""
    clock, out = FakeClock(), io.StringIO()
    with Progress(as_json, clock, Console(file=out)) as shown:
        events = JobProgress(shown, 60, notes=str(folder))
        with beating(beat_path(folder, "a")) as one, beating(beat_path(folder, "b")) as other:
            for clock.now_s in (0.0, 10.0, 20.0, 30.0, 40.0):
                stage, labels = ("grasps", 0) if clock.now_s < 30 else ("plan", 20)
                one(stage, labels)
                other(stage, labels)
                events.tick(JobTotals(10, in_flight=2))
    return out.getvalue().splitlines()


def test_a_job_shows_grasps_and_labels_before_its_first_shard_is_done(tmp_path: Path) -> None:
    lines = show(tmp_path, as_json=False)
    assert any("computing grasps of 2 objects" in line and len(line) <= 80 for line in lines)
    assert lines[-1].startswith("shards 0/10  1 labels/s  0:09:20 left") and len(lines[-1]) <= 80
    last = json.loads(show(tmp_path, as_json=True)[-1])
    assert (last["labels"], last["labels_in_flight"], last["left_s"]) == (0, 40, 560)

"""A small job as a program of its own, for tests that interrupt or kill it.

python -m tests.faults.job RUN SECONDS_PER_SHARD [ADDRESS [PATIENCE_S]]

PATIENCE_S: how long a server of the cluster at ADDRESS may be silent, instead of 20 s.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass

from datagen.cluster import ray_nodes
from datagen.cluster.attempt_guard import Meter, notes_of_a_job
from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.job_monitor import JobProgress
from datagen.cluster.protocol import EXIT_CODES, AttemptResult, StopRequest, stop_on_signals
from datagen.cluster.ray_cluster import RaySettings
from datagen.cluster.ray_executor import ray_executor
from datagen.cluster.run_recorder import RunRecorder
from datagen.cluster.shard_policy import RetryPolicy
from datagen.display.progress import Progress
from datagen.schemas.run import Run
from tests.made_runs import write


@dataclass(frozen=True)
class RandomRows:
    """A shard of random rows that takes its time."""

    run: str
    seconds: float
    shard: int
    attempt: str
    deadline_s: float
    notes: str


def make_rows(task: RandomRows, meter: Meter) -> AttemptResult:
    """Write and commit the shard."""
    run = Run.open(task.run)
    run.ledger.start(task.attempt, task.shard)
    time.sleep(task.seconds)
    commit = write(run, task.shard, task.attempt).model_copy(update={"cost": meter.cost()})
    return AttemptResult(run.commit(commit), commit.samples, commit.positives, commit.cost)


def main() -> int:
    """Run the missing shards; print the summary as JSON."""
    place, seconds, address = sys.argv[1], float(sys.argv[2]), (*sys.argv[3:4], "local")[0]
    if patience := sys.argv[4:]:
        ray_nodes._PATIENCE_S = float(patience[0])
    run, settings = Run.open(place), RaySettings(address=address, workers=2)
    missing = run.missing()
    with (
        notes_of_a_job() as notes,
        ray_executor(make_rows, settings) as executor,
        stop_on_signals(StopRequest()) as stop,
        Progress(as_json=True) as shown,
    ):

        def make_task(order: AttemptOrder) -> RandomRows:
            return RandomRows(place, seconds, order.shard, order.attempt, order.deadline_s, notes)

        events = JobProgress(shown, run.layout.samples_per_shard)
        summary = drive(missing, make_task, executor, RunRecorder(run), RetryPolicy(), events, stop)
    said = {
        "end": summary.end,
        "cause": summary.cause,
        "closed": run.close_lost_attempts(),
        "outcomes": summary.totals.outcomes,
    }
    print(json.dumps(said))
    return EXIT_CODES.get(summary.end, 0)


if __name__ == "__main__":
    sys.exit(main())

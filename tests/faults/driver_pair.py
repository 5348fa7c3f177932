"""Two drivers on one run: one winner a shard, and what the loser's work was."""

from __future__ import annotations

from pathlib import Path

from datagen.schemas.run import Run
from tests.faults.counted import SAMPLES_PER_SHARD, all_at_once, await_ends, check_run, start_driver
from tests.made_runs import make_run


def drive_in_pairs(
    folder: Path, shards: int, seconds: float, workers: int, stubborn: bool = False, drivers: int = 2
) -> dict[str, float]:
    """Let drivers begin together at one run and go on to its end; check it.

    With `stubborn` none heeds the others: what was before they made way.
    """
    run = make_run(folder / "run", n=shards * SAMPLES_PER_SHARD, shards=())
    counted = folder / "executions"
    counted.touch()
    together = all_at_once(drivers)
    pair = [start_driver(run, counted, seconds, workers, stubborn, together) for _ in range(drivers)]
    for driver in pair:
        driver.join()
        assert driver.exitcode == 0
    await_ends(counted)
    told = check_run(Run.open(run.storage.url), counted)
    names = {run.commit_of(shard).attempt.split("-")[1] for shard in run.planned()}
    return {"drivers that won shards": len(names)} | told

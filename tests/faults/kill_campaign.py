"""Random kill -9 of workers and drivers over a run that is resumed until all kills are spent."""

from __future__ import annotations

import os
import random
import signal
import time
from pathlib import Path

from datagen.schemas.run import Run
from tests.faults.counted import SAMPLES_PER_SHARD, await_ends, check_run, executions, start_driver
from tests.made_runs import make_run


def kill_at_random(
    folder: Path, worker_kills: int, driver_kills: int, shards: int, seconds: float, workers: int, seed: int
) -> dict[str, float]:
    """Kill as often as asked while the run is made, resume it to its end, and check it.

    A run that is done before every kill was spent is extended. `seconds` is what a shard takes.
    """
    rng = random.Random(seed)
    run = make_run(folder / "run", n=shards * SAMPLES_PER_SHARD, shards=())
    counted = folder / "executions"
    counted.touch()
    killed_workers = killed_drivers = drivers = 0
    while run.missing() or killed_workers < worker_kills or killed_drivers < driver_kills:
        if not run.missing():
            run.grow(run.n + shards * SAMPLES_PER_SHARD)
        driver = start_driver(run, counted, seconds, workers)
        drivers += 1
        left = driver_kills - killed_drivers
        # The kills of workers are spread over the drivers' lives.
        to_kill = -(-(worker_kills - killed_workers) // (left + 1))
        before = len(executions(counted).begun)
        while driver.is_alive():
            time.sleep(rng.uniform(0, 2 * seconds))
            if to_kill > 0:
                done = _kill_a_worker(counted, rng, driver.pid)
                to_kill, killed_workers = to_kill - done, killed_workers + done
            elif left and len(executions(counted).begun) - before > rng.randrange(2 * workers):
                os.kill(driver.pid, signal.SIGKILL)
                killed_drivers += 1
                break
        driver.join()
        assert left or driver.exitcode == 0, f"a driver ended with {driver.exitcode}"
    await_ends(counted)
    told = check_run(Run.open(run.storage.url), counted, killed_workers + killed_drivers)
    return {"workers killed": killed_workers, "drivers killed": killed_drivers, "drivers": drivers} | told


def _kill_a_worker(counted: Path, rng: random.Random, driver: int) -> int:
    """SIGKILL to one of the latest workers that is still there; how many that were."""
    latest = [line.split() for line in counted.read_text().splitlines()[-16:]]
    pids = sorted({int(pid) for _, _, pid in latest} - {driver})
    rng.shuffle(pids)
    for pid in pids:
        try:
            if b"forkserver" in Path(f"/proc/{pid}/cmdline").read_bytes():
                os.kill(pid, signal.SIGKILL)
                return 1
        except (FileNotFoundError, ProcessLookupError):
            continue
    return 0

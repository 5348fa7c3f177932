"""Workers and drivers killed at random moments: the run is the one that nobody disturbed."""

from __future__ import annotations

from tests.faults.counted import memory_folder
from tests.faults.kill_campaign import kill_at_random


def test_kills_of_workers_and_drivers_change_nothing_and_every_execution_is_in_the_ledger() -> None:
    with memory_folder() as folder:
        told = kill_at_random(
            folder, worker_kills=10, driver_kills=3, shards=30, seconds=0.05, workers=2, seed=1
        )
    assert (told["workers killed"], told["drivers killed"]) == (10, 3)
    assert told["attempts wasted"] >= 5 and told["drivers"] >= 4

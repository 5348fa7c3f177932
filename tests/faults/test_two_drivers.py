"""Two real drivers on one run, in processes of their own."""

from __future__ import annotations

from tests.faults.counted import memory_folder
from tests.faults.driver_pair import drive_in_pairs


def test_every_shard_has_one_winner_and_the_losers_work_is_waste_in_the_ledger() -> None:
    with memory_folder() as folder:
        told = drive_in_pairs(folder, shards=40, seconds=0.02, workers=2, stubborn=True)
    assert told["ended superseded"] >= 5 and told["drivers that won shards"] >= 1


def test_drivers_make_way_for_each_other() -> None:
    with memory_folder() as folder:
        told = drive_in_pairs(folder, shards=80, seconds=0.2, workers=2)
    assert told["drivers that won shards"] == 2
    assert told["attempts wasted"] < 40  # each of the first windows, and at their meetings: not every shard

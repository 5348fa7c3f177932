"""What the driver costs per shard: a simulated cluster for the loop, a real folder for the ledger.

python -m benchmarks.driver [--shards 1000000] [--ledger 2000] [--ray 1000]
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from pathlib import Path

from cluster.driver import Order, drive
from cluster.guard import Meter, utc_now
from cluster.policy import Policy
from cluster.ray_cluster import RaySettings, ray_cluster
from cluster.ray_executor import RayExecutor
from cluster.stop import StopRequest
from cluster.task import Product
from schemas.run_records import Cost, LedgerEntry
from tests.cluster.simulated import FakeClock, Heard, PaperBooks, SimulatedExecutor
from tests.faults.scripted import ScriptedTask
from tests.made_runs import make_run

_TROUBLE = ("crashed", "failed", "lost")


class SilentEvents(Heard):
    """A display that keeps nothing, so that memory shows the driver's own."""

    def ended(self, report: object, action: str) -> None:
        return


def loop(shards: int) -> tuple[float, float]:
    """(milliseconds per shard, growth of peak memory in MiB) of the loop with 1 % of failures."""
    clock = FakeClock()

    def fate(order: Order, n: int) -> tuple[str, float]:
        troubled = n == 1 and order.shard % 100 == 0
        return (_TROUBLE[order.shard // 100 % 3] if troubled else "committed", 20.0 + order.shard % 7)

    executor = SimulatedExecutor(clock, fate, slots=256)
    before, start_s = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
    books = PaperBooks(keep_entries=False)
    summary = drive(
        range(shards), lambda o: o, executor, books, Policy(), SilentEvents(), StopRequest(), clock
    )
    took_s = time.perf_counter() - start_s
    assert summary.tally.committed == shards
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    return took_s / shards * 1e3, grown / 1024


def ledger(entries: int) -> float:
    """Milliseconds to write one ledger entry durably in a local folder."""
    with tempfile.TemporaryDirectory() as folder:
        run = make_run(Path(folder) / "run", shards=())
        start_s = time.perf_counter()
        for i in range(entries):
            entry = LedgerEntry(
                attempt=f"a{i}", shard=i, outcome="committed", ended=utc_now(), cost=Cost(wall_s=1, cpu_s=1)
            )
            run.ledger.end(entry)
        return (time.perf_counter() - start_s) / entries * 1e3


def nothing(task: ScriptedTask, meter: Meter) -> Product:
    """The shortest shard there is."""
    return Product(True, 1, 0, meter.cost())


def through_ray(shards: int) -> float:
    """Empty shards per second through a local Ray cluster of two slots."""
    settings = RaySettings(workers=2)
    with ray_cluster(settings) as ray, tempfile.TemporaryDirectory() as notes:
        executor = RayExecutor(nothing, settings, ray)

        def make_task(order: Order) -> ScriptedTask:
            return ScriptedTask(order.shard, order.attempt, order.deadline_s, notes)

        def run(count: int) -> None:
            books, events = PaperBooks(keep_entries=False), SilentEvents()
            drive(range(count), make_task, executor, books, Policy(), events, StopRequest())

        run(50)  # workers start here
        start_s = time.perf_counter()
        run(shards)
        return shards / (time.perf_counter() - start_s)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--shards", type=int, default=1_000_000)
    parser.add_argument("--ledger", type=int, default=2000)
    parser.add_argument("--ray", type=int, default=1000)
    options = parser.parse_args()
    per_shard_ms, grown_mib = loop(options.shards)
    print(f"{'driver loop, simulated':34} {options.shards:>9} shards {per_shard_ms:9.3f} ms/shard")
    print(f"{'  growth of peak memory':34} {'':>9}        {grown_mib:9.1f} MiB")
    print(f"{'ledger entry, durable':34} {options.ledger:>9}        {ledger(options.ledger):9.3f} ms")
    print(
        f"{'empty shards by Ray, 2 slots':34} {options.ray:>9}        {through_ray(options.ray):9.0f} per s"
    )


if __name__ == "__main__":
    main()

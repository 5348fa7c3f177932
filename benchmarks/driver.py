"""Cost of the driver per shard: a simulated cluster for the loop, a real folder for the ledger.

python -m benchmarks.driver [--shards 1000000] [--nodes 64] [--ledger 2000] [--ray 1000]
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from pathlib import Path

from datagen.cluster.attempt_guard import Meter
from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.protocol import AttemptResult, JobSummary, StopRequest
from datagen.cluster.ray_cluster import RaySettings, ray_cluster
from datagen.cluster.ray_executor import RayExecutor
from datagen.cluster.shard_policy import RetryPolicy
from datagen.schemas.record_files import utc_now
from datagen.schemas.run_records import Cost, LedgerEntry
from tests.cluster.bad_cluster import Silent, simulate
from tests.cluster.simulated import PaperRecorder
from tests.faults.scripted import ScriptedTask
from tests.made_runs import make_run


def loop(shards: int, nodes: int) -> tuple[JobSummary, float, float]:
    """A bad cluster driven to its end: (summary, CPU milliseconds per shard, growth of peak memory in MiB).

    The milliseconds include the simulator's. It checks the result against its own count, shard by shard.
    """
    before, start_s = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    summary, _ = simulate(shards, seed=1, nodes=nodes)
    took_s = time.process_time() - start_s
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    return summary, took_s / shards * 1e3, grown / 1024


def ledger(entries: int) -> float:
    """Milliseconds to write the end of a failed attempt, and its start, durably in a local folder."""
    with tempfile.TemporaryDirectory() as folder:
        run = make_run(Path(folder) / "run", shards=())
        start_s = time.perf_counter()
        for i in range(entries):
            entry = LedgerEntry(
                attempt=f"a{i}", shard=i, outcome="failed", ended=utc_now(), cost=Cost(wall_s=1, cpu_s=1)
            )
            run.ledger.end(entry)
        return (time.perf_counter() - start_s) / entries * 1e3


def nothing(task: ScriptedTask, meter: Meter) -> AttemptResult:
    """An empty shard."""
    return AttemptResult(True, 1, 0, meter.cost())


def through_ray(shards: int) -> float:
    """Empty shards per second through a local Ray cluster of two slots."""
    settings = RaySettings(workers=2)
    with ray_cluster(settings) as ray, tempfile.TemporaryDirectory() as notes:
        executor = RayExecutor(nothing, settings, ray)

        def make_task(order: AttemptOrder) -> ScriptedTask:
            return ScriptedTask(order.shard, order.attempt, order.deadline_s, notes)

        def run(count: int) -> None:
            recorder, events = PaperRecorder(keep_entries=False), Silent()
            drive(range(count), make_task, executor, recorder, RetryPolicy(), events, StopRequest())

        run(50)  # workers start here
        start_s = time.perf_counter()
        run(shards)
        return shards / (time.perf_counter() - start_s)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--shards", type=int, default=1_000_000)
    parser.add_argument("--nodes", type=int, default=64, help="of four slots each")
    parser.add_argument("--ledger", type=int, default=2000)
    parser.add_argument("--ray", type=int, default=1000)
    options = parser.parse_args()
    summary, per_shard_ms, grown_mib = loop(options.shards, options.nodes)
    print(
        f"{'driver and simulated cluster':34} {options.shards:>9} shards {per_shard_ms:9.3f} ms/shard (CPU)"
    )
    print(f"{'  growth of peak memory':34} {'':>9}        {grown_mib:9.1f} MiB")
    totals = summary.totals
    ends = {
        "committed": totals.committed,
        "committed by lost workers": totals.superseded + totals.elsewhere,
        "quarantined": totals.quarantined,
        "attempts": sum(totals.outcomes.values()),
    } | {f"attempts {outcome}": totals.outcomes[outcome] for outcome in sorted(totals.outcomes)}
    for name, number in ends.items():
        print(f"{f'  {name}':34} {number:>9}")
    print(f"{'ledger entry, durable':34} {options.ledger:>9}        {ledger(options.ledger):9.3f} ms")
    print(
        f"{'empty shards by Ray, 2 slots':34} {options.ray:>9}        {through_ray(options.ray):9.0f} per s"
    )


if __name__ == "__main__":
    main()

"""What the store of a run costs: files, durable writes, requests to S3, merges, as a table.

    python -m benchmarks.store [--folder DIR] [--n 180000] [--latency-s 0.03]

Rows are random, with clouds of 4,096 points (the worst case for size). DIR is on the file system to be
measured [the present folder]. S3 is a server of this machine behind a proxy that adds the latency.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from datagen import cli
from datagen.cluster.driver import AttemptOrder, drive
from datagen.cluster.protocol import AttemptReport, StopRequest
from datagen.cluster.run_recorder import RunRecorder
from datagen.cluster.shard_policy import RetryPolicy
from datagen.configuration.specify import layout_of
from datagen.reports.audit import audit_runs
from datagen.schemas.checking.check_runs import Checked, check_runs
from datagen.schemas.merging import merge_runs, plan_merge
from datagen.schemas.run import Run
from datagen.schemas.run_records import Cost
from datagen.schemas.sealing import seal
from tests.cluster.bad_cluster import Silent
from tests.made_runs import attempt, make_run, small_spec
from tests.s3_servers import Faults, environment, faulty_proxy, make_bucket, moto_server
from tests.small_runs import HERE, PER_SCENE, submit_arguments

_TINY = 40  # shards
_JOB = 75  # shards
_DRIVEN = 2000
_MANY = 500


class Ended:
    """An executor whose attempts end at once, as committed ones: what is left is the driver's own work."""

    slots = 200

    def __init__(self) -> None:
        self._orders: list[AttemptOrder] = []

    def submit(self, order: AttemptOrder) -> None:
        self._orders.append(order)

    def wait(self, timeout_s: float) -> list[AttemptReport]:
        orders, self._orders = self._orders, []
        cost = Cost(wall_s=1.0, cpu_s=1.0)
        return [AttemptReport(o.attempt, o.shard, "committed", labels=10, cost=cost) for o in orders]

    def has_begun(self, attempt: str) -> bool:
        return True

    def kill(self, attempt: str) -> None:
        return None


def run_of(folder: Path, n: int) -> Run:
    """A run of n labels of random rows, 60 a scene, in shards of the size that `submit` chooses."""
    spec = small_spec(n_points=4096)
    return make_run(folder, n, layout_of(spec, n).scenes_per_shard, spec.candidates.count, spec=spec)


def files_below(folder: Path) -> tuple[int, int]:
    """Number and bytes of the files of a run."""
    sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
    return len(sizes), sum(sizes)


def tiny_shard_s(folder: Path) -> float:
    """Seconds of a tiny shard, durable: start, object, commit."""
    run = make_run(folder, n=10 * _TINY, shards=[])
    run.ledger.start("warm", 0)
    start_s = time.perf_counter()
    for shard in range(_TINY):
        assert attempt(run, shard, f"a-{shard}")
    return (time.perf_counter() - start_s) / _TINY


def cpu_per_shard(folder: Path) -> dict[str, float]:
    """CPU milliseconds of a tiny shard by what a run's whole is read for."""
    run = make_run(folder, n=10 * _MANY)
    works: dict[str, Callable[[], object]] = {
        "commit read": lambda: sum(1 for _ in run.commits()),
        "seal": lambda: seal(run.storage),
        "audit": lambda: audit_runs([run]),
        "verify": lambda: list(check_runs(run.storage, Checked())),
    }
    found: dict[str, float] = {}
    for name, work in works.items():
        start_s = time.process_time()
        work()
        found[name] = 1e3 * (time.process_time() - start_s) / _MANY
    return found


def on_s3(latency_s: float) -> tuple[float, float]:
    """(requests a shard of a whole job of 75, shards that a driver ends a second)."""
    faults = Faults(delay_s=latency_s)
    with tempfile.TemporaryDirectory() as logs, moto_server(Path(logs) / "log") as port:
        make_bucket(port, "bucket")
        with faulty_proxy(port, faults) as proxy:
            os.environ.update(environment(proxy))
            # A run of one scene has shards of one scene; those counted are its extension.
            words = submit_arguments(Path(logs) / "job", PER_SCENE, "--no-seal")
            words[words.index("--out") + 1] = "s3://bucket/job"
            more = ["resume", "s3://bucket/job", "--n", str((1 + _JOB) * PER_SCENE), *HERE]
            for command in (words, more):
                before = faults.seen["requests"]
                if cli.run(command):
                    sys.exit("the job on S3 failed")
            requests = (faults.seen["requests"] - before) / _JOB
            assert len(Run.open("s3://bucket/job").committed()) == 1 + _JOB
            run = make_run("s3://bucket/run", n=10 * _DRIVEN, shards=[])
            start_s = time.perf_counter()
            recorder, stop = RunRecorder(run), StopRequest()
            drive(range(_DRIVEN), lambda order: order, Ended(), recorder, RetryPolicy(), Silent(), stop)
            return requests, _DRIVEN / (time.perf_counter() - start_s)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path())
    parser.add_argument("--n", type=int, default=180_000)
    parser.add_argument("--latency-s", type=float, default=0.03)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        root = Path(folder)
        run = run_of(root / "run", options.n)
        shards, stored = files_below(root / "run" / "shards")
        start_s = time.perf_counter()
        seal(run.storage)
        sealed_s = time.perf_counter() - start_s
        files, size = files_below(root / "run")
        _row(f"shards of {options.n:,} labels", f"{shards}", f"{stored / 1e6:,.0f} MB")
        _row("files of the run, sealed", f"{files}", f"{size / 1e6:,.0f} MB")
        _row("seal", f"{sealed_s:.2f} s")
        _row("tiny shard, durable", f"{1e3 * tiny_shard_s(root / 'tiny'):.1f} ms")
        small, large = run_of(root / "small", 600), run_of(root / "large", 9000)
        start_s = time.perf_counter()
        merge_runs(plan_merge([small.storage.url, large.storage.url], str(root / "merged")))
        merged_s = time.perf_counter() - start_s
        _row("merge of 600 and 9,000 labels", f"{merged_s:.2f} s", f"{files_below(root / 'merged')[0]} files")
        for name, cpu_ms in cpu_per_shard(root / "many").items():
            _row(f"{name}, a tiny shard", f"{cpu_ms:.2f} ms", "of CPU")
    requests, rate = on_s3(options.latency_s)
    _row("requests a shard of a job of 75, all included", f"{requests:.1f}")
    _row(f"shards a driver ends, S3 at {1e3 * options.latency_s:g} ms", f"{rate:,.0f}/s")


def _row(name: str, *values: str) -> None:
    print(f"{name:46}", *(f"{value:>12}" for value in values))


if __name__ == "__main__":
    main()

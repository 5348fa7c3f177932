"""Seconds until a large run answers: open and resume, status, audit, with and without the index.

python -m benchmarks.faults.listing [--commits 1000 10000 100000] [--keep FOLDER]

The records are real, one commit of some sixty files a shard; the files of the shards themselves are not
made, because none of these verbs reads them. Each answer is timed in a process of its own.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from datagen.schemas.keys import commit_key
from datagen.schemas.record_files import encode_record, utc_now
from datagen.schemas.run import Run
from datagen.schemas.run_records import AttemptStart, Cost, FileEntry, Host, LedgerEntry
from datagen.schemas.shard_files import encode_shard
from datagen.schemas.summaries import CommitSummary, Summaries, refresh
from tests.made_runs import commit_of, make_run, rows_of

_ANSWERS = {
    "open + missing": ("from datagen.schemas.run import Run", "len(Run.open(place).missing())"),
    "status": ("from datagen.reports.run_status import status_report", "status_report(Run.open(place))"),
    "audit": ("from datagen.reports.spending import account_for", "account_for([Run.open(place)])"),
}
_TIMED = """
import json, sys, time
from pathlib import Path
from datagen.schemas.run import Run
place = sys.argv[1]
{imported}
start_s = time.perf_counter()
{answer}
took_s = time.perf_counter() - start_s
peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
print(json.dumps([took_s, int(peak.split()[1]) / 1024]))
"""
_STAGES = ("draw", "settle", "observe", "visibility", "write")


def make_large(folder: Path, commits: int) -> Run:
    """A run with the records of this many shards, written without waiting for the disk."""
    run = make_run(folder, n=10 * commits, shards=())
    files = encode_shard(run.schema, run.layout, run.manifest.spec_hash, *rows_of(run, 0))
    for name in ("commits", "ledger"):
        (folder / name).mkdir(exist_ok=True)
    for shard in range(len(run.committed()), commits):
        entries = tuple(
            FileEntry(path=path, size=len(data), sha256=f"{shard:032x}{i:032x}")
            for i, (path, data) in enumerate(files.items())
        )
        attempt = f"{shard:06d}-0a1b2c3d-{shard:06d}"
        seconds = {stage: (shard * 7919 + i * 104729) % 1_000_003 / 1e6 for i, stage in enumerate(_STAGES)}
        cost = Cost(
            wall_s=sum(seconds.values()) + 0.01,
            cpu_s=sum(seconds.values()),
            stage_wall_s=seconds,
            stage_cpu_s=seconds,
            peak_rss_bytes=400_000_000 + shard,
            written_bytes=sum(entry.size for entry in entries),
        )
        host = Host(name="node", cpu="cpu", cores=64, memory_bytes=2**38, pid=shard // 200)
        commit = commit_of(run, shard, attempt, entries, shard % 10, {"no_base": shard % 3})
        commit = commit.model_copy(update={"cost": cost, "host": host})
        end = LedgerEntry(
            attempt=attempt,
            shard=shard,
            outcome="committed",
            started=utc_now(),
            ended=utc_now(),
            cost=cost,
            host=host,
        )
        start = AttemptStart(attempt=attempt, shard=shard, started=utc_now(), host="node")
        (folder / commit_key(shard)).write_bytes(encode_record(commit))
        (folder / f"ledger/{attempt}.start.json").write_bytes(encode_record(start))
        (folder / f"ledger/{attempt}.json").write_bytes(encode_record(end))
    return run


def answer_times(run: Run) -> dict[str, tuple[float, float]]:
    """Seconds and MiB of peak memory of each answer, in a fresh process each."""
    times: dict[str, tuple[float, float]] = {}
    for name, (imported, answer) in _ANSWERS.items():
        program = _TIMED.format(imported=imported, answer=answer)
        done = subprocess.run(
            [sys.executable, "-c", program, run.storage.url], check=True, capture_output=True, text=True
        )
        took_s, mib = json.loads(done.stdout)
        times[name] = (took_s, mib)
    return times


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--commits", type=int, nargs="*", default=[1000, 10_000, 100_000])
    parser.add_argument("--keep", type=Path, help="make the runs here and keep them")
    options = parser.parse_args()
    print(f"{'commits':>8} {'':16} {'with index':>20} {'without':>20}")
    for commits in options.commits:
        with tempfile.TemporaryDirectory() as scratch:
            run = make_large((options.keep or Path(scratch)) / f"run-{commits}", commits)
            without = answer_times(run)
            start_s = time.perf_counter()
            refresh(run)
            refresh_s = time.perf_counter() - start_s
            commit = CommitSummary.model_validate(run.commit_of(0), from_attributes=True)
            assert next(Summaries(run).commits()) == commit
            for name, (took_s, mib) in answer_times(run).items():
                columns = [f"{s:>8.2f} s {m:>5.0f} MiB" for s, m in ((took_s, mib), without[name])]
                print(f"{commits:>8} {name:16} {' '.join(columns)}")
            sizes = [file.size for file in run.storage.list("index")]
            line = f"{refresh_s:>8.2f} s, {len(sizes)} files, {sum(sizes) / 2**20:.1f} MiB"
            print(f"{commits:>8} {'index anew':16} {line}")
            start_s = time.perf_counter()
            refresh(run)
            print(f"{commits:>8} {'index as it is':16} {time.perf_counter() - start_s:>8.2f} s", flush=True)


if __name__ == "__main__":
    main()

"""Time and memory of the verbs that read a whole run, over its number of commits.

python -m benchmarks.faults.many_commits [--commits 2000] [--folder DIR]

A run of tiny shards of random rows lacks its last two. `status` opens it, `resume` makes the two, first
without the sealed store, then with it, and `verify` checks all. Each verb is a process of its own. Ends with
1 where one does not end with 0. DIR is on the file system to be measured [in memory].
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.faults.many_scenes import CONFIG, PER_SCENE
from datagen.schemas.run import Run
from tests.faults.counted import memory_folder
from tests.made_runs import attempt

_LACKING = 2  # shards


def measured(words: Sequence[str]) -> tuple[int, float, float]:
    """Exit code, wall seconds and peak MiB of a command line."""
    start_s = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "datagen.cli", *words], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return process.returncode, time.perf_counter() - start_s, usage.ru_maxrss / 1024


def filled_run(folder: Path, commits: int) -> Run:
    """A run as `submit` makes it, with N shards, of which the last two are open."""
    (folder / "config.toml").write_text(CONFIG)
    words = ["--candidates-per-scene", str(PER_SCENE), "--config", str(folder / "config.toml"), "--no-seal"]
    given = [
        "submit",
        "heuristic",
        "--n",
        str(PER_SCENE),
        "--workers",
        "0",
        "--out",
        str(folder / "run"),
        *words,
    ]
    code, _, _ = measured(given)
    if code:
        sys.exit(f"the run ended with {code}")
    run = Run.open(folder / "run")
    run.grow(commits * run.layout.samples_per_shard)
    for shard in list(run.missing())[:-_LACKING]:
        assert attempt(run, shard, f"a-{shard}")
    return run


def rows_of(run: Run) -> Iterator[tuple[str, int, float, float]]:
    """Each verb with its exit code, seconds and MiB."""
    path = run.storage.url
    for name, words in {
        "status": ["status", path],
        "resume, without the store": ["resume", path, "--workers", "0", "--no-seal"],
        "resume, the store alone": ["resume", path, "--workers", "0"],
        "verify": ["verify", path],
    }.items():
        yield name, *measured(words)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--commits", type=int, default=2000)
    parser.add_argument("--folder", type=Path, help="make the run below this folder")
    options = parser.parse_args()
    bad = 0
    with tempfile.TemporaryDirectory(dir=options.folder) if options.folder else memory_folder() as folder:
        start_s = time.perf_counter()
        run = filled_run(Path(folder), options.commits)
        print(f"{len(run.committed()):,} commits in {time.perf_counter() - start_s:.0f} s", flush=True)
        for name, code, took_s, peak_mib in rows_of(run):
            bad += bool(code)
            print(f"{name:28} exit {code} {took_s:>8.1f} s {peak_mib:>8.0f} MiB", flush=True)
        print(f"{len(run.committed()):,} commits")
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()

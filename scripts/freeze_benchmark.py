"""Write the definition of a benchmark from complete runs: their specifications, sizes and digests.

    python scripts/freeze_benchmark.py RUNS [--version 1]

RUNS/benchmark.json lists the runs by name, with their descriptions and objects. It is rewritten from the runs
RUNS/NAME. A run that is missing or incomplete keeps its specification and stays unfrozen.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from datagen.evaluation.benchmark import DEFINITION, Benchmark, BenchmarkRun, digests_of, read_benchmark
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.safe_files import whole_file


def frozen(run: BenchmarkRun, path: Path) -> BenchmarkRun:
    """The run with the specification and digests of that at `path`. Raises InputError if it is incomplete."""
    made = Run.open(path)
    found = digests_of(path)
    return run.model_copy(update={"n": made.n, "spec": made.manifest.spec, "digests": found})


def main() -> int:
    """Freeze the runs that are complete, and report the others."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--version")
    options = parser.parse_args()
    try:
        before = read_benchmark(options.runs)
    except InputError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    runs: dict[str, BenchmarkRun] = {}
    for name, run in before.runs.items():
        try:
            runs[name] = frozen(run, options.runs / name)
            print(f"{name}: frozen, {runs[name].n:,} labels")
        except InputError as error:
            runs[name] = run.model_copy(update={"digests": None})
            print(f"{name}: not frozen ({error})")
    after = Benchmark(version=options.version or before.version, runs=runs)
    with whole_file(options.runs / DEFINITION, alone=True) as file:
        file.write((after.model_dump_json(indent=1, exclude_unset=False) + "\n").encode())
    return 0 if all(run.digests for run in runs.values()) else 1


if __name__ == "__main__":
    sys.exit(main())

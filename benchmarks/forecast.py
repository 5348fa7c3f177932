"""How often the 80 % intervals of `datagen submit --dry-run` hold, over small runs of mixed specifications.

Each run is forecast from a pilot in a new process and then made in another one. CPU seconds and bytes are
those of its commits. Wall time depends on the load of the machine, which is printed too.

    python -m benchmarks.forecast --assets DIR --out build/forecast [--runs 30] [--first 0]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from datagen.reports.spending import account_for
from datagen.schemas.run import Run

QUANTITIES = ("cpu_s", "stored_bytes", "wall_s")
# Label source, whether on real houses and objects, candidates per scene, their set, workers.
KINDS = [
    ("heuristic", True, 60, "grid", 0),
    ("heuristic", False, 60, "grid", 0),
    ("plan", True, 15, "in-range", 0),
    ("heuristic", True, 30, "in-range", 0),
    ("heuristic", True, 15, "clear", 2),
    ("sim", True, 6, "in-range", 0),
    ("heuristic", False, 20, "clear", 0),
]
SCENES = [12, 16, 20, 24, 32]


def arguments(number: int, assets: Path) -> list[str]:
    """The options of one run, without --out."""
    source, is_real, per_scene, within, workers = KINDS[number % len(KINDS)]
    scenes = SCENES[number % len(SCENES)]
    words = [source, "--n", str(scenes * per_scene), "--seed", str(1000 + number), "--workers", str(workers)]
    words += ["--candidates-per-scene", str(per_scene)] if within == "grid" else [
        *("--candidates", within, "--candidates-per-scene", str(per_scene))
    ]  # fmt: skip
    if is_real:
        words += ["--houses", f"procthor:{assets}/procthor", "--objects", f"ycb:{assets}/ycb"]
    return words


def called(*words: str) -> str:
    """Output of the command. Exits with its errors where it fails."""
    done = subprocess.run(
        [sys.executable, "-m", "datagen.cli", *words], capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(f"datagen {' '.join(words)}\n{done.stderr}")
    return done.stdout


def measure(number: int, assets: Path, out: Path) -> dict[str, Any]:
    """The forecast and the truth of one run."""
    words = ["submit", *arguments(number, assets), "--out", str(out / f"{number:03d}" / "run")]
    load = os.getloadavg()[0]
    forecast = json.loads(called(*words, "--dry-run", "--json"))
    began_s = time.monotonic()
    called(*words)
    wall_s = time.monotonic() - began_s
    spent = account_for([Run.open(words[-1])])
    truth = {"cpu_s": spent.useful.cpu_s, "stored_bytes": spent.useful.written_bytes, "wall_s": wall_s}
    row: dict[str, Any] = {"number": number, "words": words, "load": [load, os.getloadavg()[0]]}
    for name in QUANTITIES:
        row[name] = {"truth": truth[name], **forecast[name]}
    return row


def main() -> None:
    """Print one line a run, and the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--assets", type=Path, required=True, help="folder with procthor/ and ycb/")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs; rows there are kept")
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--first", type=int, default=0, help="number of the first run; decides its seed")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    table = options.out / "rows.jsonl"
    rows = [json.loads(line) for line in table.read_text().splitlines()] if table.exists() else []
    done = {row["number"] for row in rows}
    numbers = range(options.first, options.first + options.runs)
    for number in numbers:
        if number not in done:
            rows.append(measure(number, options.assets, options.out))
            with table.open("a") as file:
                file.write(json.dumps(rows[-1]) + "\n")
            print(shown(rows[-1]), flush=True)
    print_coverage([row for row in rows if row["number"] in numbers])


def shown(row: dict[str, Any]) -> str:
    """One line: each quantity as truth, interval, and whether it holds."""
    parts = [f"{row['number']:3d} {row['words'][1]:9s}"]
    for name in QUANTITIES:
        q = row[name]
        inside = "in" if q["low"] <= q["truth"] <= q["high"] else "OUT"
        parts.append(f"{name} {q['truth']:.4g} ({q['low']:.4g} to {q['high']:.4g}) {inside}")
    return "  ".join(parts)


def print_coverage(rows: list[dict[str, Any]]) -> None:
    """Share of intervals that hold, their relative width, and the error of the median."""
    print("\n| quantity | runs | interval holds | below | above | half width | median off by |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name in QUANTITIES:
        low, middle, high, truth = (
            np.array([row[name][key] for row in rows]) for key in ("low", "middle", "high", "truth")
        )
        holds = np.mean((low <= truth) & (truth <= high))
        width = np.median((high - low) / 2 / middle)
        off = np.median(np.log(truth / middle))
        print(
            f"| {name} | {len(rows)} | {holds:.0%} "
            f"| {np.mean(truth < low):.0%} | {np.mean(truth > high):.0%} "
            f"| {width:.1%} | {np.expm1(off):+.1%} |"
        )
    loads = np.array([row["load"] for row in rows])
    print(
        f"\nload average {loads.mean():.1f} ({loads.min():.1f} to {loads.max():.1f}), {os.cpu_count()} cores"
    )


if __name__ == "__main__":
    main()

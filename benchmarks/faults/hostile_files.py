"""Hostile files wherever a verb reads one: expects one line, exit code 2, little memory and no waiting.

    python -m benchmarks.faults.hostile_files [--only WORD] [--memory-gb 2] [--limit-s 300]

Each case is a process of its own below a limit of memory, and all must be refused: they end with exit code
2 and one printable line, and write nothing outside of their folders. Ends with 1 where a promise broke.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from benchmarks.faults.hostile_kinds import ARCHIVES, HOUSE_FILES, ODD_FILES, TEXTS, TOML_FILES
from tests.datagen.assets.flaky_server import Site, serve
from tests.refusals import without_phases
from tests.workers.houses.house_files import two_rooms, write_houses
from tests.workers.objects.toy_set import write_bundle

_ROOM_BYTES = 10**8  # that a case may leave on the disk


@dataclass(frozen=True)
class Case:
    """A command line over hostile files; `passes` are its exit codes, `cache` its part of the cache."""

    verb: str
    kind: str
    words: list[str]
    passes: tuple[int, ...] = (2,)
    cache: str = "shared"


@dataclass(frozen=True)
class Outcome:
    """How a case ended: its peak memory, its time, and the promise that broke, "" where none did."""

    case: Case
    peak_mib: float
    took_s: float
    broken: str


def houses_cases(folder: Path) -> Iterator[Case]:
    """Folders of houses with one hostile file each."""
    submit = ["submit", "heuristic", "--n", "16", "--workers", "0", "--out", str(folder / "run")]
    for name, make in HOUSE_FILES.items():
        home = write_houses(folder / f"houses {name}", [])
        (home / "houses.jsonl.gz").write_bytes(make())
        yield Case("submit --houses", name, [*submit, "--houses", f"procthor:{home}"])
    for name in ("houses.jsonl.gz", "houses.jsonl", "source.json", "asset_sizes.json"):
        for kind, put in ODD_FILES.items():
            home = write_houses(folder / f"houses {kind} {name}", [two_rooms()], name="good.jsonl")
            (home / name).unlink(missing_ok=True)
            put(home / name)
            yield Case("submit --houses", f"{kind} as {name}", [*submit, "--houses", f"procthor:{home}"])
    for name, text in TEXTS.items():
        house = two_rooms()
        house["rooms"][0]["id"] = text
        home = write_houses(folder / f"houses {name}", [house])
        yield Case("submit --houses", f"room id with {name}", [*submit, "--houses", f"procthor:{home}"])


def objects_cases(folder: Path) -> Iterator[Case]:
    """Folders of objects with one file replaced by something that is not a regular file."""
    submit = ["submit", "heuristic", "--n", "16", "--workers", "0", "--out", str(folder / "run")]
    for name in ("objects.json", "textured.obj", "texture_map.png", "collision.obj"):
        for kind, put in ODD_FILES.items():
            home = write_bundle(folder / f"objects {kind} {name}", "box")
            file = next(iter(sorted(home.rglob(f"*{Path(name).suffix}"))), home / name)
            file = next(iter(home.rglob(name)), file)
            file.unlink()
            put(file)
            words = [*submit, "--objects", f"ycb:{home}"]
            yield Case("submit --objects", f"{kind} as {file.name}", words)


def option_cases(folder: Path) -> Iterator[Case]:
    """Files that options name."""
    submit = ["submit", "heuristic", "--n", "16", "--workers", "0", "--out", str(folder / "run")]
    for kind, put in {**ODD_FILES, **TOML_FILES}.items():
        path = folder / f"option {kind}.toml"
        put(path)
        yield Case("submit --config", kind, [*submit, "--config", str(path)])
        if kind in ODD_FILES:
            robot = ["--base-height", "0.7", "--reach", "0.9", "--camera-height", "1.2"]
            yield Case("predict CHECKPOINT", kind, ["predict", str(path), *robot, "--frame", str(path)])
            yield Case(
                "relabel --config",
                kind,
                ["relabel", str(folder), "--config", str(path), "--out", str(folder / "o")],
            )
            locked = folder / f"locked {kind}"
            locked.mkdir()
            put(locked / "assets.lock.json")
            yield Case("assets fetch", f"{kind} as lock", ["assets", "fetch", "ycb", "--out", str(locked)])
    for out in ("/proc/x", "/sys/x", "/dev/null/x", "/dev/null", "", "x" * 5000, f"{folder}/{'x' * 5000}"):
        words = [*submit[:-1], out]
        yield Case("submit --out", out[:12] or "empty", words)


def archive_cases(folder: Path, site: Site) -> Iterator[Case]:
    """Archives from a server, trusted on first use: `ycb-scans` has no published digest.

    What is harmless in them may be unpacked.
    """
    for number, (kind, make) in enumerate(ARCHIVES.items()):
        site.files[f"/{number}/013_apple_google_16k.tgz"] = make()
        words = ["assets", "fetch", "ycb-scans/013_apple", "--mirror", f"{site.url}/{number}"]
        home = folder / f"fetch {number}"
        yield Case("assets fetch", kind, [*words, "--out", str(home / "out")], (0, 2), f"fetch {number}")


def run_case(case: Case, scratch: Path, memory_bytes: int, limit_s: float) -> Outcome:
    """Run the command below the limit of memory and look at what it printed and left."""
    environment = {
        **os.environ,
        "DATAGEN_CACHE": str(scratch / "cache" / case.cache),
        "OMP_NUM_THREADS": "1",
        "NO_COLOR": "1",
    }

    started_s = time.perf_counter()
    with (scratch / "told").open("w+b") as output:
        command = [sys.executable, "-m", "datagen.cli", *case.words]
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=output, env=environment
        )
        resource.prlimit(process.pid, resource.RLIMIT_DATA, (memory_bytes, memory_bytes))
        late = threading.Timer(limit_s, process.kill)
        late.start()
        _, status, usage = os.wait4(process.pid, 0)
        late.cancel()
        process.returncode = os.waitstatus_to_exitcode(status)
        output.seek(0)
        text = output.read().decode("utf-8", "replace")
        lines = [line for line in without_phases(text) if line[:1] != "{"]
    took_s = time.perf_counter() - started_s
    broken = f"no answer in {limit_s:g} s" if took_s >= limit_s else ""
    if not broken and process.returncode not in case.passes:
        broken = f"exit code {process.returncode}: {lines[-1][:200] if lines else ''}"
    elif (
        not broken
        and process.returncode
        and (len(lines) != 1 or not lines[0].startswith("error: ") or not lines[0].isprintable())
    ):
        broken = f"{len(lines)} lines, the last {lines[-1][:200]!r}" if lines else "no line is printed"
    return Outcome(case, usage.ru_maxrss / 1024, took_s, broken)


def rows_of(outcomes: list[Outcome]) -> Iterator[tuple[str, ...]]:
    """One row per verb: kinds tried, kinds refused as promised, largest memory and longest time of one."""
    groups: dict[str, list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        groups[outcome.case.verb].append(outcome)
    yield "verb", "tried", "one line, 2", "peak MiB", "longest s"
    for verb, found in groups.items():
        good = sum(not o.broken for o in found)
        peak, longest = max(o.peak_mib for o in found), max(o.took_s for o in found)
        yield verb, str(len(found)), str(good), f"{peak:.0f}", f"{longest:.1f}"


def main() -> None:
    """Print the table; ends with 1 where a promise broke."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--only", default="", help="cases whose verb or kind holds this word [all]")
    options.add_argument("--memory-gb", type=float, default=2.0, help="memory of each process [2]")
    options.add_argument("--limit-s", type=float, default=300.0, help="time of each process [300]")
    chosen = options.parse_args()
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory() as scratch, serve() as site:
        folder = Path(scratch) / "files"
        folder.mkdir()
        makers: tuple[Callable[[], Iterator[Case]], ...] = (
            lambda: houses_cases(folder),
            lambda: objects_cases(folder),
            lambda: option_cases(folder),
            lambda: archive_cases(folder, site),
        )
        for case in (case for make in makers for case in make()):
            if chosen.only in f"{case.verb} {case.kind}":
                outcomes.append(run_case(case, Path(scratch), int(chosen.memory_gb * 2**30), chosen.limit_s))
        left = sum(p.lstat().st_size for p in (Path(scratch) / "cache").rglob("*") if p.is_file())
        outside = [p for p in Path(scratch).iterdir() if p.name not in ("files", "cache", "told")]
    for row in rows_of(outcomes):
        print("".join(f"{cell:>14}" if k else f"{cell:<22}" for k, cell in enumerate(row)))
    broken = [f"{o.case.verb}, {o.case.kind}: {o.broken}" for o in outcomes if o.broken]
    broken += [f"outside of its folder: {path.name}" for path in outside]
    broken += [f"{left:,} bytes are left in the cache"] if left > _ROOM_BYTES else []
    for line in broken:
        print(line)
    if broken:
        raise SystemExit(1)


if __name__ == "__main__":
    main()

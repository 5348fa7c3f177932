"""One system call of a real program fails: how it ends, and what doing it again gives.

strace lets call number N of one kind fail in the program's first thread. Calls are counted in a run that
nothing disturbs; only those below the folder are hit.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from datagen import cli
from datagen.schemas.errors import InputError
from datagen.schemas.fields import SCHEMAS
from datagen.schemas.run import Run
from datagen.schemas.sealing import seal
from tests.faults.crash_points_operations import damage, small_schema, units
from tests.made_runs import attempt, attempts_of, make_run

REPOSITORY = Path(__file__).resolve().parents[2]
_CALLS = ("openat", "read", "write", "fsync", "renameat2", "rename", "renameat", "link", "linkat", "mkdir",
          "mkdirat", "unlink", "unlinkat", "getdents64", "newfstatat", "fstat")  # fmt: skip
_READING = ("read", "getdents64", "newfstatat", "fstat", "unlink", "unlinkat")  # never for lack of room


@dataclass(frozen=True)
class Operation:
    """`prepare` makes what is there before; `words` are the command in that folder; its codes of failure."""

    name: str
    prepare: Callable[[Path], object]
    words: Callable[[Path], list[str]]
    places: tuple[str, ...] = ("",)
    codes: tuple[int, ...] = (2,)


@dataclass
class Outcome:
    """How many calls failed, how the programs ended, and which promises were broken."""

    tried: int = 0
    refused: int = 0
    wrong: list[str] = field(default_factory=list[str])


def _apart(folder: Path) -> None:
    for name, shards in (("a", [0, 1]), ("b", [1, 2])):
        make_run(folder / name, 30, shards=shards)


def _damaged(folder: Path) -> None:
    seal(make_run(folder, 30).storage)
    for key in ("copies/manifest.json", "ledger/a-1.start.json", "data.zarr/label/c.0"):
        (folder / key).unlink()


OPERATIONS = (
    Operation("attempt", lambda folder: make_run(folder, 20, shards=[0]), lambda f: ["attempt", str(f)]),
    Operation(
        "seal", lambda folder: make_run(folder, 20), lambda f: ["verify", str(f), "--repair"], codes=(1, 2)
    ),
    Operation(
        "merge",
        _apart,
        lambda f: ["merge", str(f / "a"), str(f / "b"), "--out", str(f / "out")],
        places=("out",),
    ),
    # What cannot be read or put back is a finding.
    Operation("repair", _damaged, lambda f: ["verify", str(f), "--repair"], codes=(1, 2)),
)


def program(words: list[str]) -> int:
    """What is traced: a verb, or one attempt at shard 1, on runs of few files."""
    SCHEMAS["heuristic"] = small_schema()
    if words[0] != "attempt":
        return cli.run(words)
    try:
        run = Run.open(words[1])
        if 1 not in run.committed():
            attempt(run, 1, f"b-{len(attempts_of(run))}")
        run.close_lost_attempts()  # as every driver does
    except InputError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    return 0


def can_trace() -> bool:
    """Whether strace is here and may trace another process."""
    strace = shutil.which("strace")
    return bool(strace) and subprocess.run([strace, "true"], capture_output=True, check=False).returncode == 0


def try_errors(operation: Operation, work: Path, sample: int, rng: np.random.Generator) -> Outcome:
    """Let a sample of the operation's calls fail, one in each run of it, and do it again."""
    before = dict(SCHEMAS)
    SCHEMAS["heuristic"] = small_schema()
    try:
        clean, folder = work / f"{operation.name}-clean", work / operation.name
        operation.prepare(clean)
        shutil.copytree(clean, folder)
        _, log = _run(operation, folder, work)
        whole, outcome = _lasting(operation, folder), Outcome()
        points = _points(log, folder)
        for k in sorted(rng.choice(len(points), min(sample, len(points)), replace=False)):
            call, number = points[k]
            error = "EIO" if call in _READING else ("EIO", "ENOSPC", "EDQUOT")[rng.integers(3)]
            shutil.rmtree(folder)
            shutil.copytree(clean, folder)
            _try(operation, folder, work, f"{call}:error={error}:when={number}", whole, outcome)
        return outcome
    finally:
        SCHEMAS.update(before)


def _try(
    operation: Operation, folder: Path, work: Path, inject: str, whole: dict[str, str], outcome: Outcome
) -> None:
    done, log = _run(operation, folder, work, inject)
    hits = [line for line in log.splitlines() if "(INJECTED)" in line]
    if not any(str(folder) in line for line in hits):
        return  # the interpreter's own calls were others this time
    outcome.tried += 1
    outcome.refused += done.returncode != 0
    where = f"{operation.name} {inject}: {hits[0][:200]}"
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    if done.returncode not in (0, *operation.codes) or "Traceback" in done.stderr:
        outcome.wrong.append(f"{where}: ended with {done.returncode}: {done.stderr[-500:]}")
    if done.returncode == 2 and len(errors) != 1:
        outcome.wrong.append(f"{where}: {len(errors)} lines of error")
    if done.returncode == 0 and _lasting(operation, folder) != whole:
        outcome.wrong.append(f"{where}: it said that it had succeeded")
    again, _ = _run(operation, folder, work)
    if again.returncode != 0:
        outcome.wrong.append(f"{where}: again it ended with {again.returncode}: {again.stderr[-300:]}")
    if _lasting(operation, folder) != whole:
        outcome.wrong.append(f"{where}: done again, it gives something else")
    outcome.wrong += [f"{where}: damaged: {what}" for what in damage(folder, operation.places)]


def _run(
    operation: Operation, folder: Path, work: Path, inject: str = ""
) -> tuple[subprocess.CompletedProcess[str], str]:
    log = work / "log"
    tracing = ["strace", "-f", "-y", "-s", "200", "--seccomp-bpf", "-e", f"trace={','.join(_CALLS)}"]
    tracing += ["-e", f"inject={inject}"] if inject else []
    command = [sys.executable, "-m", "tests.faults.storage_errors_campaign", *operation.words(folder)]
    environment = {
        **os.environ,
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONHASHSEED": "0",
        "OMP_NUM_THREADS": "1",
    }
    done = subprocess.run(
        [*tracing, "-o", str(log), *command],
        cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return done, log.read_text(errors="replace")


def _points(log: str, folder: Path) -> list[tuple[str, int]]:
    """(call, its number among those of its kind) of the first thread's calls below the folder."""
    counts: dict[str, int] = {}
    points: list[tuple[str, int]] = []
    first = log.split(" ", 1)[0]
    for line in log.splitlines():
        if found := re.match(rf"{first} +([a-z0-9_]+)\(", line):
            counts[found[1]] = counts.get(found[1], 0) + 1
            if f"{folder}/" in line or f"{folder}>" in line or f'{folder}"' in line:
                points.append((found[1], counts[found[1]]))
    return points


def _lasting(operation: Operation, folder: Path) -> dict[str, str]:
    """What readers see of the places, but for the ledger: doing it again is another attempt."""
    found = units(folder, operation.places)
    return {name: value for name, value in found.items() if ":ledger " not in name}


if __name__ == "__main__":
    sys.exit(program(sys.argv[1:]))

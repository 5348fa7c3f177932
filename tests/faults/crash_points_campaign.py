"""Kill or fail an operation at each of its calls, and see that every unit is absent or there, whole.

This process has everything imported, and starts no thread: it forks a child for each
point, and another that looks with fresh eyes. Run as a program it prints its findings as JSON.
"""

from __future__ import annotations

import argparse
import errno
import gc
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy.random  # noqa: F401 - loaded once, not in every child
from zarr.core.sync import cleanup_resources

from datagen.schemas.errors import InputError
from datagen.schemas.fields import SCHEMAS, sized_schema
from datagen.schemas.shard_files import group_metadata
from tests.faults.crash_points_forking import REFUSED, Files, bytes_of, copy_tree, files_below, in_child, must
from tests.faults.crash_points_operations import (
    LAYOUT,
    OPERATIONS,
    Operation,
    Units,
    damage,
    small_schema,
    units,
)
from tests.faults.crash_points_shim import Call, Mode, Shim, read_log
from tests.made_runs import small_spec

REPOSITORY = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Point:
    """One call at which something happens: its number from 1, and the error or 0 for a kill."""

    mode: Mode
    at: int
    error: int = 0


@dataclass
class Finding:
    """What an operation showed. `absent` and `there` count points; `between`, those with some units of
    several there; `violations` say what was neither."""

    operation: str
    calls: int
    points: int = 0
    absent: int = 0
    there: int = 0
    between: int = 0
    refused: int = 0
    violations: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Reference:
    """An operation that nothing disturbed: what was before and after it, and its calls."""

    before_files: Files
    after_files: Files
    before: Units
    after: Units
    calls: list[Call]


def campaign(work: Path, operations: Iterable[Operation], sample: int | None) -> list[Finding]:
    """Try the operations at all their points, or at N of each kind of end."""
    findings: list[Finding] = []
    for operation in operations:
        _warm_up(operation)
        known = _reference(work, operation)
        finding = Finding(operation.name, len(known.calls))
        for point in points(known.calls, sample):
            _try(work, operation, known, point, finding)
        shutil.rmtree(work / operation.name)
        findings.append(finding)
    return findings


def _warm_up(operation: Operation) -> None:
    """Set the operation's schema, and do what every child would begin with; no thread is left."""
    SCHEMAS["heuristic"] = small_schema(operation.fields)
    for seed in (0, 1):
        spec = small_spec(seed)
        group_metadata(sized_schema("heuristic", spec), LAYOUT, spec.hash())
    cleanup_resources()
    gc.collect()
    gc.freeze()  # or a child's first collection would copy every page


def points(calls: list[Call], sample: int | None) -> list[Point]:
    """Every end at every call, or of each kind of end a sample with the first and the last calls in it."""
    numbers = range(1, len(calls) + 1)
    kinds = [
        [Point(Mode.KILL, k) for k in numbers],
        [Point(Mode.KILL_HALF_WRITTEN, k) for k in numbers if calls[k - 1].kind == "write"],
        [Point(Mode.FAIL_ONCE, k, errno.EIO) for k in numbers],
        [Point(Mode.FAIL_FROM_HERE, k, errno.ENOSPC) for k in numbers],
    ]
    if sample is not None:
        draw = random.Random(len(calls))
        # What counts is often done by the first or the last calls.
        ends = [(kind[0], kind[1:-1], kind[-1]) for kind in kinds if kind]
        kinds = [[first, *draw.sample(rest, min(sample, len(rest))), last] for first, rest, last in ends]
    return [point for kind in kinds for point in kind]


def trace(work: Path, operations: Iterable[Operation], log: Path) -> None:
    """Run the operations once each, and log their calls. Who traces finds them by the names looked for."""
    with log.open("wb") as f:
        for operation in operations:
            _warm_up(operation)
            _trace_one(work / operation.name.replace(" ", "_"), operation, f)


def _trace_one(folder: Path, operation: Operation, log: BinaryIO) -> None:
    def act() -> None:
        log.write(f"begin {folder}\n".encode())
        log.flush()
        Path(f"{folder}.begin").exists()
        shim = Shim(folder, Mode.COUNT, log=log.fileno())
        operation.act(folder)
        shim.disarm()
        Path(f"{folder}.end").exists()

    must(lambda: operation.prepare(folder))
    must(act)


def _reference(work: Path, operation: Operation) -> _Reference:
    home = work / operation.name
    home.mkdir()
    template, after = home / "before", home / "after"
    must(lambda: operation.prepare(template))
    copy_tree(template, after)
    log = home / "log"
    with log.open("wb") as f:

        def act() -> None:
            Shim(after, Mode.COUNT, log=f.fileno())
            operation.act(after)

        must(act)
    return _Reference(
        files_below(template),
        files_below(after),
        _look(template, operation),
        _look(after, operation),
        read_log(log.read_text()),
    )


def _try(work: Path, operation: Operation, known: _Reference, point: Point, finding: Finding) -> None:
    place = work / operation.name / "point"
    copy_tree(work / operation.name / "before", place)

    def act() -> None:
        Shim(place, point.mode, point.at, point.error)
        operation.act(place)

    status, told = in_child(act)
    finding.points += 1
    call = known.calls[point.at - 1]
    where = f"{point.mode.name} {point.error or ''} at {point.at}: {call.kind} {Path(call.path).name}"

    def violated(what: str) -> None:
        finding.violations.append(f"{where}: {what}")

    if point.error:
        if status == REFUSED:
            finding.refused += 1
            if "\n" in told:
                violated(f"an error of several lines: {told}")
            if call.kind not in ("unlink", "rmdir"):
                for name in _drafts(files_below(place), known):
                    violated(f"left behind: {name}")
        elif status != 0:
            violated(f"ended with {status}: {told}")
    elif status not in (-9, 0):
        violated(f"ended with {status}: {told}")
    ended = status == 0
    for name, data in known.before_files.items():
        is_kept = known.after_files.get(name) == data and not re.search(r"(^|/)data[-.]", name)  # a unit
        if is_kept and bytes_of(place / name) != data:
            violated(f"changed {name}")
    # One fresh process looks, goes on as a user would, and looks again.
    now, resumed, damaged = _look_and_resume(place, operation)
    _judge(now, known, finding, violated, ended)
    if _lasting(resumed) != _lasting(known.after):
        violated(f"resumed to something else: {_different(resumed, known.after)}")
    other = files_below(place).keys() ^ known.after_files.keys()
    if operation.exact and other:
        violated(f"resumed with other files: {sorted(other)}")
    for what in damaged:
        violated(f"resumed, and damaged: {what}")


def _drafts(now: Iterable[str], known: _Reference) -> list[str]:
    """New files that belong to nothing: drafts, and those of a sealed store that is not written whole.

    An object or a store that is, and lacks only its record, is left to `verify --clean`: its record may be
    on its way.
    """
    new = set(now) - known.before_files.keys()
    stores = {name: found[0] for name in new if (found := re.match(r"(?:.*/)?data(?:-[0-9]+)?\.zarr/", name))}
    half = {store for store in stores.values() if f"{store}zarr.json" not in now}
    return sorted(name for name in new if name.endswith(".part") or stores.get(name) in half)


def _judge(
    now: Units, known: _Reference, finding: Finding, violated: Callable[[str], None], ended: bool
) -> None:
    """Every unit is as before or as after, and as after where the operation came to its end."""
    states: set[str] = set()
    for name in sorted({*now, *known.before, *known.after}):
        old, value, new = known.before.get(name), now.get(name), known.after.get(name)
        if old == new == value or (":ledger " in name and name not in known.before):
            continue  # the account of a new attempt follows its commit, or comes with who resumes
        if value == new:
            states.add("there")
        elif value == old or ((old or "").startswith("refused") and value in (None, "refused: no such file")):
            states.add("absent")  # damaged before, and set aside: its object first, then its commit
        else:
            violated(f"{name} is {value!r}, was {old!r}, should be {new!r}")
    if ended and "absent" in states:
        violated("it said that it had succeeded")
    state = "between" if len(states) > 1 else next(iter(states), "there")
    setattr(finding, state, getattr(finding, state) + 1)


def _lasting(found: Units) -> Units:
    """Units without the ledger's: whoever resumes is another attempt."""
    return {name: value for name, value in found.items() if ":ledger " not in name}


def _different(one: Units, other: Units) -> list[str]:
    return [name for name in sorted({*one, *other}) if one.get(name) != other.get(name)]


def _look(folder: Path, operation: Operation) -> Units:
    """The units, seen by a process that has never seen the run."""
    status, told = in_child(lambda: json.dumps(units(folder, operation.places)))
    return json.loads(told) if status == 0 else {"readers": told}


def _look_and_resume(folder: Path, operation: Operation) -> tuple[Units, Units, list[str]]:
    """(units, units when it was resumed, what `verify` finds then)."""

    def go() -> str:
        now = units(folder, operation.places)
        try:
            (operation.resume or operation.act)(folder)
        except InputError as e:
            return json.dumps([now, {"resuming": str(e)}, []])
        return json.dumps([now, units(folder, operation.places), damage(folder, operation.places)])

    status, told = in_child(go)
    now, resumed, damaged = json.loads(told) if status == 0 else ({"readers": told}, {}, [])
    return now, resumed, damaged


# As a program, and how to start it --------------------------------------------------------------


def run_campaign(names: Iterable[str], sample: int | None) -> list[Finding]:
    """The campaign over the named operations, or all, in a process of its own."""
    more = [] if sample is None else ["--sample", str(sample)]
    done = start([*more, *(f"--only={name}" for name in names)], stdout=subprocess.PIPE)
    return [Finding(**found) for found in json.loads(done.stdout)]


def start(arguments: list[str], before: Iterable[str] = (), **how: Any) -> subprocess.CompletedProcess[str]:
    """This program; `before` are words in front of it."""
    command = [sys.executable, "-m", "tests.faults.crash_points_campaign", *arguments]
    # Libraries that start threads when imported would not survive the forks.
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    return subprocess.run([*before, *command], cwd=REPOSITORY, env=environment, check=True, text=True, **how)


def main() -> None:
    """Try the named operations, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sample", type=int, help="points of each kind of end, in place of all")
    parser.add_argument("--trace", type=Path, help="only run the operations, and log their calls there")
    parser.add_argument("--only", action="append", default=[], help="an operation")
    options = parser.parse_args()
    chosen = [op for op in OPERATIONS if not options.only or op.name in options.only]
    memory = Path("/dev/shm")  # copies there are quick; a kill is the same on every file system
    with tempfile.TemporaryDirectory(prefix="crash-points-", dir=memory if memory.is_dir() else None) as work:
        if options.trace:
            trace(Path(work), chosen, options.trace)
            return
        found = campaign(Path(work), chosen, options.sample)
    json.dump([asdict(finding) for finding in found], sys.stdout)


if __name__ == "__main__":
    main()

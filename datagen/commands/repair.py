"""`datagen repair`: fix what `verify` finds, from second copies or by making bad shards again."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Generator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from datagen.commands.verify import finding_row, print_findings
from datagen.console.options import AsJson, RunPlace
from datagen.console.printing import counted, listed, print_json, print_rows
from datagen.console.whole_number import WHOLE_NUMBER
from datagen.remaking.sources import AS_FOUND, Sources
from datagen.schemas.checking.mending import Mended, RemakeShard, mend_place
from datagen.schemas.errors import InputError
from datagen.schemas.progress import counting
from datagen.schemas.run import Run
from datagen.schemas.storage import open_storage

if TYPE_CHECKING:
    from datagen.remaking.shards import Origin


def repair(
    run: RunPlace,
    /,
    *,
    workers: Annotated[
        int, WHOLE_NUMBER, Parameter(help="Processes that make bad shards again; 0: this process.")
    ] = 0,
    given: Sources = AS_FOUND,
    json: AsJson = False,
) -> int:
    """Check a run as `datagen verify` does, fix the damage, and check again.

    Records are restored from their second copies. Bad shards are made again, and a file is written only if it
    has the bytes that were committed. All other files stay untouched. After an interruption, run it again.
    Exit code 0 when no damage is left, else 1.

    For example: datagen repair runs/first
    """
    if not 0 <= workers <= 256:
        raise InputError("--workers", str(workers), "is not between 0 and 256", "Omit it for this process")
    place = open_storage(run, probe=False, create=False)
    with (
        counting("shards checked", as_json=json) as seen,
        _remaking(given, workers) as remake,
    ):
        mended = mend_place(place, remake, max(1, workers), seen)
    left = [finding for finding in mended.left if finding.is_damage]
    report = _report(run, mended)
    if json:
        print_json(report)
    else:
        _print(report, mended)
    return 1 if left else 0


@contextmanager
def _remaking(given: Sources, workers: int) -> Generator[RemakeShard]:
    """Give the function that makes a shard again: in this process, or in `workers` subprocesses."""
    if workers == 0:
        yield lambda run, shard: _remake(run, shard, given)
        return
    # Workers are spawned at the first bad shard.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_leave_signals)
    try:
        yield lambda run, shard: pool.submit(_remake, run, shard, given).result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _leave_signals() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C


def _remake(run: Run, shard: int, given: Sources) -> Mapping[str, bytes]:
    """The files of a shard, computed in this process."""
    # Simulators are imported only for a bad shard.
    from datagen.remaking.shards import remade_files, remake

    return remade_files(run, remake(run, shard, _origin(run.storage.url, given)))


@lru_cache(maxsize=1)  # a world is large
def _origin(place: str, given: Sources) -> Origin:
    from datagen.remaking.shards import open_origin

    return open_origin(Run.open(place), given)


def _report(run: str, mended: Mended) -> dict[str, Any]:
    return {
        "run": run,
        "clean": not any(finding.is_damage for finding in mended.left),
        "records": sorted(set(mended.records)),
        "files_from_copies": sorted(set(mended.copied_files)),
        "files_made_again": sorted(set(mended.remade_files)),
        "shards_made_again": sorted(set(mended.remade_shards)),
        "sealed_files": sorted(set(mended.sealed_files)),
        "sealed_anew": mended.resealed,
        "files_untouched": mended.untouched,
        "files_changed_by_others": mended.changed,
        "apart_from_here": _apart(mended),
        "left": [finding_row(finding) for finding in mended.left],
    }


def _apart(mended: Mended) -> list[str]:
    """Differences of this machine from the one that made the run, where remade bytes differ."""
    if not any("other bytes" in finding.mend for finding in mended.left):
        return []
    from datagen.remaking.scenes import what_differs_here

    texts = [text for run in mended.checked.runs for text in what_differs_here(run)]
    return list(dict.fromkeys(texts))


def _print(report: dict[str, Any], mended: Mended) -> None:
    made, of_shards = len(report["files_made_again"]), report["shards_made_again"]
    rows = [
        ("records", f"{len(report['records'])} restored from copies and other records"),
        ("files", f"{len(report['files_from_copies'])} restored from copies"),
        ("", f"{made} made again" + (f", of shards {listed(of_shards)}" if of_shards else "")),
        ("sealed", "anew" if mended.resealed else f"{counted(len(report['sealed_files']), 'file')} mended"),
        ("untouched", counted(mended.untouched, "file")),
    ]
    if mended.changed:
        rows.append(
            (
                "changed",
                f"{counted(len(mended.changed), 'file')} by another process meanwhile: is a job running?",
            )
        )
    if any("other bytes" in finding.mend for finding in mended.left):
        apart = "; ".join(report["apart_from_here"]) or "nothing that the run's records name"
        rows.append(("differs here", apart))
    left = sum(finding.is_damage for finding in mended.left)
    state = f"{counted(left, 'finding')} left" if left else "clean"
    print_rows(f"{state}: {report['run']}", rows)
    print_findings("left", mended.left, len(mended.left))

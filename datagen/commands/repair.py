"""`datagen repair`: what `verify` finds, mended from second copies or by making bad shards again."""

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
from datagen.regeneration.sources import AS_FOUND, Sources
from datagen.schemas.checking.repair import RemakeShard, Repaired, repair_runs
from datagen.schemas.errors import InputError
from datagen.schemas.progress import counting
from datagen.schemas.run import Run
from datagen.schemas.storage import open_storage

if TYPE_CHECKING:
    from datagen.regeneration.shards import OpenedSources


def repair(
    run: RunPlace,
    *,
    workers: Annotated[
        int, WHOLE_NUMBER, Parameter(help="Processes that make bad shards again; 0 works in this one.")
    ] = 0,
    given: Sources = AS_FOUND,
    json: AsJson = False,
) -> int:
    """Check a run as verify does, mend what can be mended, and check again.

    Records come back from their second copies, files of shards by making only the bad shards again; a
    file is written only with the very bytes that were committed. All other files stay as they are. It can
    be broken off and begun again at any time. Exit code 0 when nothing is left, 1 when something is.
    """
    if not 0 <= workers <= 256:
        raise InputError("--workers", str(workers), "is not between 0 and 256", "Leave it out for none")
    place = open_storage(run, probe=False, create=False)
    with (
        counting("shards checked", as_json=json) as seen,
        _remaking(given, workers) as regenerate_shard,
    ):
        mended = repair_runs(place, regenerate_shard, max(1, workers), seen)
    left = [finding for finding in mended.left if finding.is_damage]
    report = _report(run, mended)
    if json:
        print_json(report)
    else:
        _print(report, mended)
    return 1 if left else 0


@contextmanager
def _remaking(given: Sources, workers: int) -> Generator[RemakeShard]:
    """How shards are made again: in this process, or in so many others."""
    if workers == 0:
        yield lambda run, shard: _remake(run, shard, given)
        return
    # Workers are spawned when the first shard is bad, and not before.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_leave_signals)
    try:
        yield lambda run, shard: pool.submit(_remake, run, shard, given).result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _leave_signals() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle


def _remake(run: Run, shard: int, given: Sources) -> Mapping[str, bytes]:
    """The files of a shard, computed here."""
    # Simulators are imported only where a shard is bad.
    from datagen.regeneration.shards import regenerate_shard, regenerated_files

    return regenerated_files(run, regenerate_shard(run, shard, _origin(run.storage.url, given)))


@lru_cache(maxsize=1)  # a world is large
def _origin(place: str, given: Sources) -> OpenedSources:
    from datagen.regeneration.shards import open_sources

    return open_sources(Run.open(place), given)


def _report(run: str, mended: Repaired) -> dict[str, Any]:
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


def _apart(mended: Repaired) -> list[str]:
    """In what this machine is not the one that made the run, where remade bytes were not the committed."""
    if not any("other bytes" in finding.mend for finding in mended.left):
        return []
    from datagen.regeneration.scenes import what_differs_here

    texts = [text for run in mended.checked.runs for text in what_differs_here(run)]
    return list(dict.fromkeys(texts))


def _print(report: dict[str, Any], mended: Repaired) -> None:
    made, of_shards = len(report["files_made_again"]), report["shards_made_again"]
    rows = [
        ("records", f"{len(report['records'])} put back from copies and other records"),
        ("files", f"{len(report['files_from_copies'])} put back from copies"),
        ("", f"{made} made again" + (f", of shards {listed(of_shards)}" if of_shards else "")),
        ("sealed", "anew" if mended.resealed else f"{counted(len(report['sealed_files']), 'file')} mended"),
        ("all others", f"the bytes and times that they had: {counted(mended.untouched, 'file')}"),
    ]
    if mended.changed:
        rows.append(
            ("changed", f"{counted(len(mended.changed), 'file')} meanwhile, not by this: is a job at work?")
        )
    if any("other bytes" in finding.mend for finding in mended.left):
        apart = "; ".join(report["apart_from_here"]) or "nothing that the run's records tell of"
        rows.append(("differs here", apart))
    left = sum(finding.is_damage for finding in mended.left)
    state = f"{counted(left, 'finding')} left" if left else "clean"
    print_rows(f"{state}: {report['run']}", rows)
    print_findings("left", mended.left, len(mended.left))

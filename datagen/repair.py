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

from datagen.console.counting import counting
from datagen.console.printing import print_json, print_rows
from datagen.console.whole_number import WHOLE_NUMBER
from datagen.verify import finding_row, print_findings
from schemas.checking.mending import Mended, RemakeShard, mend_place
from schemas.errors import InputError
from schemas.run import Run
from schemas.storage import open_storage

if TYPE_CHECKING:
    from datagen.remaking.shards import Origin

Sources = tuple[str | None, str | None, str | None]


def repair(
    run: Annotated[str, Parameter(help="The run's folder or s3:// address; also of merged runs.")],
    *,
    workers: Annotated[
        int, WHOLE_NUMBER, Parameter(help="Processes that make bad shards again; 0 works in this one.")
    ] = 0,
    houses: Annotated[str | None, Parameter(help="Houses, where they have moved since.")] = None,
    objects: Annotated[str | None, Parameter(help="Objects, where they have moved since.")] = None,
    scenes_from: Annotated[
        str | None, Parameter(help="The run whose scenes this one labelled, where it has moved since.")
    ] = None,
    json: Annotated[bool, Parameter(negative=(), help="Print one JSON document.")] = False,
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
        counting("checked", as_json=True if json else None) as seen,
        _remaking((houses, objects, scenes_from), workers) as remake,
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
def _remaking(sources: Sources, workers: int) -> Generator[RemakeShard]:
    """How shards are made again: in this process, or in so many others."""
    if workers == 0:
        yield lambda run, shard: _remake(run, shard, sources)
        return
    # Workers are spawned when the first shard is bad, and not before.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_leave_signals)
    try:
        yield lambda run, shard: pool.submit(_remake, run, shard, sources).result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _leave_signals() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle


def _remake(run: Run, shard: int, sources: Sources) -> Mapping[str, bytes]:
    """The files of a shard, computed here."""
    # Simulators are imported only where a shard is bad.
    from datagen.remaking.shards import remade_files, remake

    return remade_files(run, remake(run, shard, _origin(run.storage.url, sources)))


@lru_cache(maxsize=1)  # a world is large
def _origin(place: str, sources: Sources) -> Origin:
    from datagen.remaking.shards import open_origin

    return open_origin(Run.open(place), *sources)


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
    """In what this machine is not the one that made the run, where remade bytes were not the committed."""
    if not any("other bytes" in finding.mend for finding in mended.left):
        return []
    from datagen.remaking.scenes import what_differs_here

    texts = [text for run in mended.checked.runs for text in what_differs_here(run)]
    return list(dict.fromkeys(texts))


def _print(report: dict[str, Any], mended: Mended) -> None:
    rows = [
        ("records", f"{len(report['records'])} put back from copies and other records"),
        ("files", f"{len(report['files_from_copies'])} put back from copies"),
        ("", f"{len(report['files_made_again'])} made again, of shards {report['shards_made_again'][:10]}"),
        ("sealed", "anew" if mended.resealed else f"{len(report['sealed_files'])} files mended"),
        ("all others", f"{mended.untouched:,} files have the bytes and times they had"),
    ]
    if mended.changed:
        rows.append(
            ("changed", f"{len(mended.changed)} files changed meanwhile, not by this: is a job at work?")
        )
    if any("other bytes" in finding.mend for finding in mended.left):
        apart = "; ".join(report["apart_from_here"]) or "nothing that the run's records tell of"
        rows.append(("differs here", apart))
    left = sum(finding.is_damage for finding in mended.left)
    print_rows(f"{'clean' if not left else f'{left} findings left'}: {report['run']}", rows)
    print_findings("left", mended.left, len(mended.left))

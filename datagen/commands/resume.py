"""`datagen resume`: make what is missing of a run, or of merged runs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from typing_extensions import Unpack

from datagen.console.command_lines import words_of
from datagen.console.options import RunPlace
from datagen.console.printing import counted
from datagen.jobs.detach import detach_job
from datagen.jobs.going_on import go_on, open_work, source_words
from datagen.jobs.job import JobResult
from datagen.jobs.options import HERE, Placing, Where, absolute_place, opening
from datagen.jobs.report import reported
from datagen.remaking.sources import AS_FOUND, Sources
from datagen.schemas.merged import open_runs
from datagen.schemas.quarantine import lift_quarantine
from datagen.schemas.storage import open_storage


def verb(
    run: RunPlace,
    *,
    quarantined: Annotated[
        bool,
        Parameter(negative=(), help="Try the shards in quarantine again; their records stay as history."),
    ] = False,
    given: Sources = AS_FOUND,
    placing: Placing = HERE,
) -> int:
    """Make every missing shard of a run, and seal it: of what was begun, nothing is made twice.

    Of merged runs every part is resumed, one after the other.
    """
    return reported(lambda: resume(run, quarantined=quarantined, given=given, placing=placing))


def resume(
    run: str | Path,
    *,
    quarantined: bool = False,
    given: Sources = AS_FOUND,
    placing: Placing | None = None,
    **where: Unpack[Where],
) -> JobResult:
    """Make every missing shard of a run or of merged runs, seal it, and return what was done.

    Args:
        run: The run's folder or s3:// address.
        quarantined: Try the shards in quarantine again.
        given: Where houses, objects and the run of its scenes lie now, if they have moved.
        placing: What the command line gives instead of `where`.
        where: As of `submit`: `workers`, `address`, `max_quarantined`, `detach` and `quiet`.

    Raises:
        InputError: The run or a source cannot be used.
        KeyboardInterrupt: The job was stopped; the run can be resumed.

    Example:
        >>> result = datagen.resume(run, workers=0, quiet=True)
        >>> result.complete, result.labels, result.remaining
        (True, 0, 0)
    """
    run, placing = str(run), placing or Placing(**where)
    placing.refuse_bad()
    words = ["resume", absolute_place(run), *words_of({"--quarantined": quarantined}), *source_words(given)]
    words += placing.words()
    if placing.detach and placing.address != "local":
        return detach_job(words, run, placing)
    with opening(words, placing) as began_s:
        place = open_storage(run, create=False)
        runs = open_runs(place)
        works = [open_work(part, given, placing.address) for part in runs]
        if placing.detach:
            return detach_job(words, run, placing)
        if quarantined:
            lifted = sum(len(lift_quarantine(part)) for part in runs)
            if not placing.quiet:
                sys.stderr.write(f"out of quarantine: {counted(lifted, 'shard')}\n")
    return go_on(place, run, works, placing, began_s, [*words, *placing.address_words()], given)

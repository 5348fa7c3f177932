"""`datagen extend`: raise the number of labels of a run, or of merged runs, and make them."""

from __future__ import annotations

from collections.abc import Sequence
from heapq import heapify, heapreplace
from typing import Annotated

from cyclopts import Parameter

from datagen.console.options import RunPlace
from datagen.console.whole_number import WHOLE_NUMBER
from datagen.jobs.detach import detach_job
from datagen.jobs.going_on import go_on, open_work, source_words
from datagen.jobs.options import HERE, Placing, absolute_place, opening, refuse_odd_n
from datagen.remaking.sources import AS_FOUND, Sources
from datagen.schemas.errors import InputError
from datagen.schemas.merged import open_runs
from datagen.schemas.run import Run
from datagen.schemas.storage import open_storage
from datagen.specifying.stored_scenes import StoredScenes, refuse_too_few


def extend(
    run: RunPlace,
    /,
    *,
    n: Annotated[int, WHOLE_NUMBER, Parameter(help="Labels wanted in total; not fewer than now.")],
    given: Sources = AS_FOUND,
    placing: Placing = HERE,
) -> int:
    """Raise the number of labels of a run to n and make the missing ones; existing shards keep their bytes.

    In merged runs, the new labels are divided evenly among the parts, in whole shards.

    For example: datagen extend runs/first --n 360,000
    """
    placing.refuse_bad()
    refuse_odd_n(n)
    words = ["extend", absolute_place(run), "--n", str(n), *source_words(given), *placing.words()]
    if placing.detach and placing.address != "local":
        return detach_job(words, run, placing)
    with opening(words, placing) as began_s:
        place = open_storage(run, create=False)
        runs = open_runs(place)
        works = [open_work(part, given, placing.address) for part in runs]
        wanted = longer(runs, n, run)
        for part, work, more in zip(runs, works, wanted, strict=True):
            if work.scenes_from:
                stored = StoredScenes(Run.open(work.scenes_from), work.houses, work.objects)
                refuse_too_few(stored, part.layout, more)
        for part, more in zip(runs, wanted, strict=True):
            part.grow(more)
    if placing.detach:
        return detach_job(words, run, placing)
    return go_on(place, run, works, placing, began_s, given)


def longer(runs: Sequence[Run], n: int, place: str) -> list[int]:
    """Return the labels of each run for n in total. InputError where n is less than there are now."""
    have = [run.n for run in runs]
    if n < sum(have):
        problem = f"{place} already has {sum(have):,} planned, and a run never shrinks"
        raise InputError("--n", str(n), problem, f"Give {sum(have)} or more")
    return shares(have, [run.layout.samples_per_shard for run in runs], n)


def shares(have: Sequence[int], per_shard: Sequence[int], n: int) -> list[int]:
    """Grow `have` by whole shards until they sum to n: evenly, and the remainder to the last.

    `per_shard` holds the labels of one shard of each run. Each new shard goes to the run with the fewest
    new labels so far, the first of equals. A store is cut only at its end, so only the last run may
    need a part of a shard.
    """
    # The common part is added at once: n may be a million shards away.
    missing = n - sum(have)
    step = missing // len(have) - max(per_shard)
    given = [max(0, step // size) * size for size in per_shard]
    missing -= sum(given)
    line = [(labels, k) for k, labels in enumerate(given)]
    heapify(line)
    while missing >= per_shard[line[0][1]]:
        labels, k = line[0]
        missing, given[k] = missing - per_shard[k], labels + per_shard[k]
        heapreplace(line, (given[k], k))
    given[-1] += missing
    return [a + b for a, b in zip(have, given, strict=True)]

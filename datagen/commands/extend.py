"""`datagen extend`: want more labels of a run, or of merged runs, and make them."""

from __future__ import annotations

from collections.abc import Sequence
from heapq import heapify, heapreplace
from typing import Annotated

from cyclopts import Parameter

from datagen.console.options import RunPlace
from datagen.console.whole_number import WHOLE_NUMBER
from datagen.jobs.going_on import continue_job, source_words
from datagen.jobs.job import Work
from datagen.jobs.options import HERE, Placing, absolute_place, refuse_odd_n
from datagen.remaking.sources import AS_FOUND, Sources
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.specifying.stored_scenes import StoredScenes, refuse_too_few


def extend(
    run: RunPlace,
    *,
    n: Annotated[int, WHOLE_NUMBER, Parameter(help="Labels wanted in all; not fewer than now.")],
    given: Sources = AS_FOUND,
    placing: Placing = HERE,
) -> int:
    """Want n labels of a run and make those that are missing; shards that exist keep their bytes.

    Merged runs share the further labels evenly, in whole shards.
    """
    placing.refuse_bad()
    refuse_odd_n(n)
    words = ["extend", absolute_place(run), "--n", str(n), *source_words(given), *placing.words()]

    def grow(works: Sequence[Work]) -> None:
        wanted = longer([work.run for work in works], n, run)
        for work, more in zip(works, wanted, strict=True):
            if work.scenes_from:
                stored = StoredScenes(Run.open(work.scenes_from), work.houses, work.objects)
                refuse_too_few(stored, work.run.layout, more)
        for work, more in zip(works, wanted, strict=True):
            work.run.grow(more)

    return continue_job(words, run, given, placing, grow)


def longer(runs: Sequence[Run], n: int, place: str) -> list[int]:
    """How many labels each run shall have so that together they have n. InputError where that is fewer."""
    have = [run.n for run in runs]
    if n < sum(have):
        problem = f"{place} already wants {sum(have):,}, and a run never shrinks"
        raise InputError("--n", str(n), problem, f"Give {sum(have)} or more")
    return shares(have, [run.layout.samples_per_shard for run in runs], n)


def shares(have: Sequence[int], per_shard: Sequence[int], n: int) -> list[int]:
    """`have` labels grown by whole shards until they are n together: evenly, and what is left to the last.

    `per_shard` are the labels of one shard of each. Each further shard goes to whoever was given the
    fewest labels so far, the first of equals. A store is cut at its end alone, so that only the last may
    want a part of a shard.
    """
    # What everybody gets in any case is given at once: n may be a million shards away.
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

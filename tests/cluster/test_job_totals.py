"""The account of one job over several runs."""

from __future__ import annotations

from functools import reduce

import pytest

from datagen.cluster.job_totals import End, JobSummary, Tally, no_work


def summary(end: End, cause: str = "", committed: int = 1) -> JobSummary:
    return JobSummary(end, cause, Tally(shards=3, committed=committed, labels=10 * committed), 2.0)


@pytest.mark.parametrize(
    ("ends", "worst", "code"),
    [
        (("complete", "failed", "complete"), "failed", 1),
        (("interrupted", "failed"), "interrupted", 130),
        (("aborted", "interrupted", "failed"), "aborted", 2),
        (("complete", "complete"), "complete", 0),
    ],
)
def test_a_job_over_several_runs_ends_as_the_worst_of_them(
    ends: tuple[End, ...], worst: End, code: int
) -> None:
    for order in (ends, ends[::-1]):
        whole = reduce(JobSummary.plus, map(summary, order), no_work())
        assert (whole.end, whole.exit_code) == (worst, code)


def test_the_first_cause_of_the_worst_end_is_told() -> None:
    parts = [summary("failed", "many"), summary("aborted", "disk"), summary("aborted", "gone")]
    assert reduce(JobSummary.plus, parts).cause == "disk"


def test_sums_are_over_all_runs() -> None:
    whole = no_work().plus(summary("complete", committed=3)).plus(summary("interrupted", committed=1))
    assert (whole.tally.shards, whole.tally.committed, whole.tally.labels) == (6, 4, 40)
    assert (whole.remaining, whole.elapsed_s) == (2, 4.0)
    assert (no_work().remaining, no_work().exit_code) == (0, 0)


def test_only_the_first_shards_in_quarantine_are_named() -> None:
    parts = [Tally(shards=30), Tally(shards=30)]
    for tally in parts:
        for shard in range(30):
            tally.count_quarantined(shard)
    both = parts[0].plus(parts[1])
    assert both.quarantined == 60 and both.quarantined_shards == list(range(20))

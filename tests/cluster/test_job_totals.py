"""The account of one job over several runs."""

from __future__ import annotations

from functools import reduce

import pytest

from datagen.cluster.protocol import EXIT_CODES, End, JobSummary, JobTotals


def summary(end: End, cause: str = "", committed: int = 1) -> JobSummary:
    return JobSummary(end, cause, JobTotals(shards=3, committed=committed, labels=10 * committed), 2.0)


@pytest.mark.parametrize(
    ("ends", "worst", "code"),
    [
        (("complete", "failed", "complete"), "failed", 1),
        (("interrupted", "failed"), "interrupted", 130),
        (("aborted", "interrupted", "failed"), "aborted", 2),
        (("complete", "complete"), "complete", 0),
        ((), "complete", 0),
    ],
)
def test_a_job_over_several_runs_ends_as_the_worst_of_them(
    ends: tuple[End, ...], worst: End, code: int
) -> None:
    for order in (ends, ends[::-1]):
        whole = reduce(JobSummary.plus, map(summary, order), JobSummary())
        assert (whole.end, EXIT_CODES.get(whole.end, 0)) == (worst, code)


def test_the_first_cause_of_the_worst_end_is_told_and_sums_are_over_all_runs() -> None:
    parts = [summary("failed", "many", 3), summary("aborted", "disk"), summary("aborted", "gone", 0)]
    whole = reduce(JobSummary.plus, parts, JobSummary())
    assert whole.cause == "disk"
    assert (whole.totals.shards, whole.totals.committed, whole.totals.labels) == (9, 4, 40)
    assert (whole.remaining, whole.elapsed_s) == (5, 6.0)

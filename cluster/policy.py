"""When to try again, when to give up, how long to wait: pure functions of plain values.

Nothing here reads a clock or draws a number, so a script of failures plays the same every time.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from datagen.cluster.task import AttemptReport

Action = Literal["done", "retry", "quarantine", "drop", "abort"]


@dataclass(frozen=True)
class Policy:
    """The budgets of a job. Seconds unless a name says otherwise."""

    max_failures: int = 3  # crash, hang, exception or bad output; then the shard is given up
    max_lost: int = 10  # losses that count against the shard (see `decide`), in a budget of their own
    max_lost_rounds: int = 5  # all that was in flight lost so many times in a row: the executor is at fault
    max_out_of_memory: int = 2
    backoff_s: float = 0.5  # wait before the second attempt; doubles with every further one
    max_backoff_s: float = 60.0
    window_factor: float = 2.0  # attempts in flight per slot, so that no worker waits for the driver
    initial_deadline_s: float = 1800.0  # before anything is known about this job's shards
    min_deadline_s: float = 60.0
    deadline_factor: float = 10.0  # over the 95th percentile of what committed attempts took
    deadlines_known_after: int = 20  # committed attempts before the percentile is believed
    grace_s: float = 10.0  # the worker's own deadline comes first; the driver's this much later
    queue_deadlines: float = 20.0  # deadlines after which an attempt that never began is lost
    drain_s: float = 60.0  # how long a stop waits for what is in flight
    kill_s: float = 10.0  # how long the driver waits for a killed attempt to be reported
    max_quarantined_share: float = 0.01  # of the shards of this job; above it the job has failed
    give_up_after: int = 20  # quarantined shards before the share may end the job early
    look_s: float = 5.0  # between two looks at what other drivers of the run have committed
    look_factor: float = 20.0  # and at least so many times as long as the last look took
    max_waiting: int = 1000  # shards that wait for a retry; with more, no new shard is begun


@dataclass(frozen=True)
class Trouble:
    """What went wrong with one shard so far. Shards without trouble have none of these."""

    failures: int = 0
    lost: int = 0  # those that count
    successes: int = 0  # of other shards in this job, when this one was last lost
    out_of_memory: int = 0
    hangs: int = 0
    attempts: tuple[str, ...] = ()
    causes: tuple[str, ...] = ()
    stacks: tuple[str, ...] = ()


@dataclass(frozen=True)
class Decision:
    """What to do after an attempt ended. `wait_s` is for retries."""

    action: Action
    trouble: Trouble
    wait_s: float = 0.0


def decide(
    policy: Policy, trouble: Trouble, report: AttemptReport, successes: int = 0, alone: bool = False
) -> Decision:
    """What to do with a shard after this report.

    A superseded attempt is done: the shard is committed, by whoever was first. A cancelled one is
    dropped: the job is stopping and the shard stays open for the next. A loss counts against the shard
    where it was `alone` in flight, or where others succeeded since it was lost before (`successes` are
    those of the job so far): a machine or a cluster that is gone loses everything, whichever shard it is.
    """
    if report.outcome in ("committed", "superseded"):
        return Decision("done", trouble)
    if report.outcome == "cancelled":
        return Decision("drop", trouble)
    if report.ends_job:
        return Decision("abort", trouble)
    lost = report.outcome == "lost"
    now = replace(
        trouble,
        failures=trouble.failures + (report.outcome in ("failed", "crashed", "hung")),
        hangs=trouble.hangs + (report.outcome == "hung"),
        lost=trouble.lost + (lost and (alone or successes > trouble.successes)),
        successes=successes if lost else trouble.successes,
        out_of_memory=trouble.out_of_memory + (report.outcome == "out_of_memory"),
        attempts=(*trouble.attempts, report.attempt),
        causes=(*trouble.causes, f"{report.outcome}: {report.cause}" if report.cause else report.outcome),
        stacks=(*trouble.stacks, report.stack),
    )
    spent = (
        now.failures >= policy.max_failures
        or now.lost >= policy.max_lost
        or now.out_of_memory >= policy.max_out_of_memory
    )
    if spent:
        return Decision("quarantine", now)
    wait_s = min(policy.backoff_s * 2 ** (len(now.attempts) - 1), policy.max_backoff_s)
    return Decision("retry", now, wait_s)


def is_suspect(trouble: Trouble) -> bool:
    """Whether the shard may be what takes its machine along: then no other suspect is in flight with it."""
    return trouble.lost >= 2


def nothing_runs(policy: Policy, lost_in_a_row: int, at_once: int) -> bool:
    """Whether the executor rather than a shard is at fault: whatever it is given, `at_once`, is lost.

    Not before the budget of a shard that is the only one left has decided.
    """
    return lost_in_a_row > max(policy.max_lost + 1, policy.max_lost_rounds * at_once)


def window(policy: Policy, slots: int) -> int:
    """How many attempts to keep in flight."""
    return max(1, math.ceil(policy.window_factor * slots))


class Durations:
    """The wall seconds of the latest committed attempts: bounded memory, cheap to ask."""

    def __init__(self) -> None:
        self._latest: deque[float] = deque(maxlen=256)
        self._seen = 0
        self._p95_s = 0.0

    def add(self, wall_s: float) -> None:
        self._latest.append(wall_s)
        self._seen += 1
        # Sorting at every shard would cost more than the answer is worth.
        if self._seen <= 32 or self._seen % 32 == 0:
            self._p95_s = percentile_95(self._latest)

    @property
    def seen(self) -> int:
        return self._seen

    @property
    def p95_s(self) -> float:
        return self._p95_s


def percentile_95(values: Sequence[float] | deque[float]) -> float:
    """The smallest value that at least 95 % of the values do not exceed; `values` is not empty."""
    ordered = sorted(values)
    return ordered[math.ceil(0.95 * len(ordered)) - 1]


def deadline_s(policy: Policy, durations: Durations, trouble: Trouble) -> float:
    """How long an attempt may run: well above what others took, doubled after each hang."""
    if durations.seen < policy.deadlines_known_after:
        base = policy.initial_deadline_s
    else:
        base = max(policy.min_deadline_s, policy.deadline_factor * durations.p95_s)
    return base * 2**trouble.hangs


def too_many_quarantined(policy: Policy, quarantined: int, shards: int) -> bool:
    """Whether the job has failed as a whole."""
    return quarantined > policy.max_quarantined_share * shards


def ends_early(policy: Policy, quarantined: int, shards: int) -> bool:
    """Whether going on would only burn money: so many shards are bad that the job has failed."""
    return quarantined >= policy.give_up_after and too_many_quarantined(policy, quarantined, shards)

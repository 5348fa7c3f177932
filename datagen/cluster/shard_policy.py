"""Which shard is tried next, and when: order, retries, quarantine and deadlines.

No function reads a clock, and random numbers are given, so decisions are reproducible in tests.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from datagen.cluster.protocol import AttemptReport
from datagen.schemas.shard_ranges import ShardRanges

Action = Literal["done", "retry", "move", "quarantine", "drop", "abort"]


@dataclass(frozen=True)
class RetryPolicy:
    """The limits of a job. Times in seconds."""

    max_failures: int = 3  # crash, hang, exception or bad output; then the shard is quarantined
    max_lost: int = 10  # losses that count against the shard (see `decide`), a separate limit
    max_lost_rounds: int = 5  # consecutive rounds in which all attempts were lost: the executor is at fault
    max_out_of_memory: int = 2
    backoff_s: float = 0.5  # wait before the second attempt; doubles with every further one
    max_backoff_s: float = 60.0
    window_factor: float = 2.0  # attempts in flight per slot, so that workers never wait for the driver
    initial_deadline_s: float = 1800.0  # before the durations of this job's shards are known
    min_deadline_s: float = 60.0
    deadline_factor: float = 10.0  # times the 95th percentile of committed attempts
    deadlines_known_after: int = 20  # committed attempts before the percentile is used
    grace_s: float = 10.0  # delay of the driver's deadline after the worker's own
    queue_deadlines: float = 20.0  # deadlines after which an attempt that has not begun is lost
    drain_s: float = 60.0  # how long a stop waits for attempts in flight
    kill_s: float = 10.0  # how long the driver waits for a killed attempt to be reported
    max_quarantined_share: float = 0.01  # share of this job's shards; above it the job fails
    give_up_after: int = 20  # quarantined shards before the share may end the job early
    look_s: float = 5.0  # between two checks of the commits of other drivers
    look_factor: float = 20.0  # and at least this multiple of the duration of the last check
    max_waiting: int = 1000  # shards that wait for a retry; with more, no new shard is started


@dataclass(frozen=True)
class ShardFailures:
    """The failures of one shard so far."""

    failures: int = 0
    lost: int = 0  # those that count
    successes: int = 0  # committed shards of this job when this one was last lost
    out_of_memory: int = 0
    hangs: int = 0
    attempts: tuple[str, ...] = ()
    causes: tuple[str, ...] = ()
    stacks: tuple[str, ...] = ()


@dataclass(frozen=True)
class Decision:
    """The action after an attempt. `wait_s` is for retries."""

    action: Action
    trouble: ShardFailures
    wait_s: float = 0.0


def decide(
    policy: RetryPolicy,
    trouble: ShardFailures,
    report: AttemptReport,
    successes: int = 0,
    alone: bool = False,
) -> Decision:
    """Decide what to do with a shard after this report.

    A superseded attempt is done: another one is committed. A cancelled one is dropped: the job is stopping,
    and the shard stays open for the next. A loss counts against the shard where it was `alone` in flight, or
    where others succeeded since its last loss (`successes` counts the job's): a lost machine or cluster loses
    all attempts, whatever the shard. The failure of an unfit machine counts against no shard.
    """
    if report.outcome in ("committed", "superseded"):
        return Decision("done", trouble)
    if report.outcome == "cancelled":
        return Decision("drop", trouble)
    if report.ends_job:
        return Decision("abort", trouble)
    if report.is_unfit:
        return Decision("move", trouble)
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


def at_once(lost_in_a_row: int, width: int) -> int:
    """How many of `width` attempts to have in flight.

    One at a time after two rounds of losses: this shows whether one shard kills the machine of all others.
    """
    return 1 if lost_in_a_row >= 2 * width else width


def nothing_runs(policy: RetryPolicy, lost_in_a_row: int, width: int) -> bool:
    """Whether the executor, not a shard, is at fault: all `width` attempts in flight are always lost.

    False until a shard that is the only one left has reached its limit of losses.
    """
    return lost_in_a_row > max(policy.max_lost + 1, policy.max_lost_rounds * width)


def window(policy: RetryPolicy, slots: int) -> int:
    """Number of attempts to keep in flight."""
    return max(1, math.ceil(policy.window_factor * slots))


class Durations:
    """The wall seconds of the latest committed attempts, in bounded memory."""

    def __init__(self) -> None:
        self._latest: deque[float] = deque(maxlen=256)
        self.seen = 0
        self.p95_s = 0.0

    def add(self, wall_s: float) -> None:
        self._latest.append(wall_s)
        self.seen += 1
        # Sorting for every shard would be too slow.
        if self.seen <= 32 or self.seen % 32 == 0:
            self.p95_s = percentile_95(self._latest)


def percentile_95(values: Sequence[float] | deque[float]) -> float:
    """The 95th percentile: the smallest value that 95 % do not exceed; `values` is not empty."""
    ordered = sorted(values)
    return ordered[math.ceil(0.95 * len(ordered)) - 1]


def deadline_s(policy: RetryPolicy, durations: Durations, trouble: ShardFailures) -> float:
    """Deadline of an attempt: well above the duration of others, doubled after each hang."""
    if durations.seen < policy.deadlines_known_after:
        base = policy.initial_deadline_s
    else:
        base = max(policy.min_deadline_s, policy.deadline_factor * durations.p95_s)
    return base * 2**trouble.hangs


def too_many_quarantined(policy: RetryPolicy, quarantined: int, shards: int) -> bool:
    """Whether the job has failed as a whole."""
    return quarantined > policy.max_quarantined_share * shards


def ends_early(policy: RetryPolicy, quarantined: int, shards: int) -> bool:
    """Whether to stop early because the job has failed already."""
    return quarantined >= policy.give_up_after and too_many_quarantined(policy, quarantined, shards)


class OpenShards:
    """Gives shards in ascending order from a random start, then from the first one on.

    Drivers with the same start would make every shard twice. A driver that meets another one continues at a
    new random position. Memory: 16 bytes per range of consecutive shards.
    """

    def __init__(self, shards: Sequence[int], rng: random.Random) -> None:
        self._rng = rng
        self._begin(ShardRanges.of(shards))

    def __len__(self) -> int:
        return len(self._shards) - self._given

    def next(self) -> int | None:
        """The next shard; None after the last."""
        if not len(self):
            return None
        self._given += 1
        return self._shards[(self._start + self._given - 1) % len(self._shards)]

    def go_elsewhere(self) -> None:
        """Continue at a random position among the remaining shards."""
        self._begin(self._left())

    def keep(self, missing: ShardRanges) -> int:
        """Drop the shards that are not in `missing`; return their number.

        Where the next shard is dropped, another driver works here: continue at a random position.
        """
        before = self._left()
        left = before.within(missing)
        if dropped := len(before) - len(left):
            ahead = self._shards[(self._start + self._given) % len(self._shards)]
            self._begin(left, ahead if ahead in left else None)
        return dropped

    def _begin(self, left: ShardRanges, start: int | None = None) -> None:
        """Continue with `left` from `start`, or from a random shard; after the last shard, from the first."""
        self._shards, self._given = left, 0
        if start is not None:
            self._start = left.position_of(start)
        else:
            self._start = self._rng.randrange(len(left)) if left else 0

    def _left(self) -> ShardRanges:
        size, end, left = len(self._shards), self._start + self._given, self._shards
        for first, past in ((self._start, min(end, size)), (0, end - size)):
            if first < past:  # consecutive shards of the set
                given = range(self._shards[first], self._shards[past - 1] + 1)
                left = left.without(ShardRanges.of(given))
        return left

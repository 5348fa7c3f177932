"""Forecast of the rest of a run, from the costs of its shards so far."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from datagen.cluster.shard_costs import Draws, Interval, ShardCosts, Variation, Work, warm_up_share
from datagen.schemas.run_records import Cost, Host

# Measured on built-in, ProcTHOR and YCB assets; benchmarks/forecast.py shows whether they hold.
BETWEEN_JOBS = {
    "cpu": Variation(0.55, 0.15),
    "wall": Variation(0.55, 0.3),
    "bytes": Variation(0.05, 0.008, warms_up=False),
}
_WITHIN_JOB = {
    "cpu": Variation(0.55, 0.03),
    "wall": Variation(0.55, 0.1),
    "bytes": Variation(0.05, 0.0, warms_up=False),
}
_KNOWN_AFTER = 3  # shards


@dataclass(frozen=True)
class MadeShard:
    """The cost of a made shard, with the parts that do not grow with its scenes, and its worker."""

    scenes: int
    cost: Cost
    worker: str  # machine and process
    fixed_cpu_s: float = 0.0
    fixed_wall_s: float = 0.0
    fixed_bytes: float = 0.0


class SeenCosts:
    """CPU seconds, wall seconds and bytes of the shards seen; `workers`: scenes that each has made."""

    def __init__(self, variation: dict[str, Variation]) -> None:
        self.cpu, self.wall, self.stored = (ShardCosts(variation[name]) for name in ("cpu", "wall", "bytes"))
        self.workers: dict[str, int] = {}

    def add(self, shard: MadeShard) -> None:
        before, scenes, cost = self.workers.get(shard.worker, 0), shard.scenes, shard.cost
        self.workers[shard.worker] = before + scenes
        self.cpu.add(cost.cpu_s, scenes, before, shard.fixed_cpu_s)
        self.wall.add(cost.wall_s, scenes, before, shard.fixed_wall_s)
        self.stored.add(cost.written_bytes, scenes, before, shard.fixed_bytes)

    @property
    def seen(self) -> int:
        return self.cpu.seen


class RunForecast:
    """Forecast of the cost of the rest of one run. `earlier` are shards made by other jobs in this run."""

    def __init__(self, scenes_per_shard: int, earlier: Iterable[MadeShard] = ()) -> None:
        self._scenes = scenes_per_shard
        self.costs = SeenCosts(_WITHIN_JOB)
        for shard in earlier:
            self.costs.add(shard)
        self.costs.workers.clear()  # those processes have ended
        self._left: tuple[tuple[int, int, int], Interval] | None = None  # the last result and its arguments

    def add(self, cost: Cost, host: Host | None) -> None:
        """Add a shard that this job has made."""
        self.costs.add(MadeShard(self._scenes, cost, worker_name(host)))

    @property
    def seen(self) -> int:
        return self.costs.seen

    def left(self, shards: int, workers: int) -> Interval | None:
        """Wall seconds until the last of these shards ends; None while too few have been seen."""
        if self.seen < _KNOWN_AFTER:
            return None
        if shards == 0:
            return Interval(0.0, 0.0, 0.0)
        key = (self.seen, shards, workers)
        if self._left is None or self._left[0] != key:
            span_s = self.costs.wall.makespan(self._work(shards, workers), workers, running=True)
            self._left = key, Interval.of(span_s)
        return self._left[1]

    def longest_shard_s(self, workers: int) -> float:
        """The 90 % quantile of the wall seconds of one further shard."""
        return self.costs.wall.bound(self._work(1, workers))

    def spending(self, shards: int, workers: int, per_cpu_s: float, per_byte: float) -> Draws:
        """Draws of the cost of these shards at prices of a CPU second and of a byte."""
        work = self._work(shards, workers)
        return per_cpu_s * self.costs.cpu.total(work) + per_byte * self.costs.stored.total(work)

    def _work(self, shards: int, workers: int) -> Work:
        """These shards, with the warm-ups of the workers that make them and have not made enough scenes."""
        made = list(self.costs.workers.values())[-workers:]
        # The workers with the fewest scenes make the next shards.
        busy = sorted([*made, *[0] * (workers - len(made))])[: max(1, min(workers, shards))]
        each = shards * self._scenes / len(busy)
        return Work(shards, self._scenes, sum(warm_up_share(before, each) for before in busy))


def worker_name(host: Host | None) -> str:
    """Machine and process of a worker; "" where unknown."""
    return f"{host.name} {host.pid}" if host else ""


def shown_range(interval: Interval) -> str:
    """The interval of a time, in one unit: 40-55 s, 12-15 min, 2.1-2.6 h."""
    unit, name = next(
        (u, n)
        for u, n in ((86400.0, "days"), (3600.0, "h"), (60.0, "min"), (1.0, "s"))
        if interval.high >= 2 * u or u == 1.0
    )
    digits = 0 if interval.high / unit >= 10 or unit == 1.0 else 1
    low, high = (f"{value / unit:.{digits}f}" for value in (interval.low, interval.high))
    return f"{high} {name}" if low == high else f"{low}-{high} {name}"

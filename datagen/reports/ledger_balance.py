"""The sums of a run's ledger compared with commits plus waste, and the records that differ."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from math import fsum

from datagen.schemas.checking.attempts import ODD_COST_FIX, odd_cost
from datagen.schemas.checking.finding import Finding, below
from datagen.schemas.record_files import REPAIR, commit_key, end_key
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit, Cost, LedgerEntry, other_value

_OR_RUNNING = f"{REPAIR}; or audit again where a job is running"


@dataclass(frozen=True)
class Balance:
    """Seconds in ledger, commits and waste, and the difference. `ledger_s` = `commits_s` + `waste_s`.

    Keys are "wall" and "cpu". The difference is exactly 0 where every record agrees with its commit, because
    each number is added once with each sign. A finding's key is the file, below its run.
    """

    ledger_s: dict[str, float]
    commits_s: dict[str, float]
    waste_s: dict[str, float]
    difference_s: dict[str, float]
    findings: tuple[Finding, ...]

    @property
    def is_exact(self) -> bool:
        """Whether the sums are equal and no record contradicts another."""
        return not self.findings and not any(self.difference_s.values())


def balance(runs: Iterable[Run]) -> Balance:
    """Add up the records of runs and compare them. Keys of findings begin with the run's address."""
    ledger: list[Cost] = []
    commits: list[Cost] = []
    waste: list[Cost] = []
    findings: list[Finding] = []
    for run in runs:
        ends = {end.attempt: end for end in run.ledger.ends()}
        committed = {commit.attempt: commit for commit in run.commits()}
        for attempt in committed.keys() - ends.keys():  # it ended after the ledger was listed, or not at all
            if (late := run.ledger.end_of(attempt)) is not None:
                ends[attempt] = late
        ledger += [end.cost for end in ends.values() if end.cost]
        commits += [commit.cost for commit in committed.values()]
        waste += [end.cost for end in ends.values() if end.cost and end.attempt not in committed]
        findings += below(f"{run.storage.url}/", _findings(committed, ends))
    added, taken = _sums(ledger), [*commits, *waste]
    left = {clock: fsum([*_clock(ledger, clock), *(-s for s in _clock(taken, clock))]) for clock in added}
    return Balance(added, _sums(commits), _sums(waste), left, tuple(findings))


def _sums(costs: Sequence[Cost]) -> dict[str, float]:
    return {clock: fsum(_clock(costs, clock)) for clock in ("wall", "cpu")}


def _clock(costs: Iterable[Cost], clock: str) -> list[float]:
    return [cost.wall_s if clock == "wall" else cost.cpu_s for cost in costs]


def _findings(committed: dict[str, Commit], ends: dict[str, LedgerEntry]) -> Iterator[Finding]:
    """Records of committed attempts that differ from their commit, ends without commit, and odd costs."""
    for attempt, commit in sorted(committed.items(), key=lambda item: item[1].shard):
        end, key, ours = ends.get(attempt), end_key(attempt), commit_key(commit.shard)
        if end is None:
            problem = f"missing, but {ours} has the attempt's cost of {_seconds(commit.cost)}"
            yield Finding(key, "account", problem, _OR_RUNNING, commit.shard)
        elif end.cost != commit.cost:
            problem = f"cost: is {_seconds(end.cost)}, but {_seconds(commit.cost)} in {ours}"
            yield Finding(key, "account", problem, REPAIR, commit.shard)
        elif other := other_value(end, shard=commit.shard, outcome="committed"):
            yield Finding(key, "account", f"{other[0]}: is not that of {ours}", REPAIR, commit.shard)
        if odd := odd_cost(commit.cost):
            yield Finding(ours, "account", odd, ODD_COST_FIX, commit.shard)
    decided = {commit.shard for commit in committed.values()}
    for attempt, end in sorted(ends.items()):
        if attempt in committed:
            continue
        if end.outcome == "committed" and end.shard not in decided:  # else the shard was made again: waste
            problem = f"outcome: is committed, but {commit_key(end.shard)} is missing"
            yield Finding(end_key(attempt), "account", problem, REPAIR, end.shard)
        if odd := odd_cost(end.cost):
            yield Finding(end_key(attempt), "account", odd, ODD_COST_FIX, end.shard)


def _seconds(cost: Cost | None) -> str:
    return "unknown" if cost is None else f"{cost.wall_s:.6g} s wall and {cost.cpu_s:.6g} s CPU"

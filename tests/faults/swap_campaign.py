"""Two whole files that exchanged their places: what checks find, and what repair brings back or leaves."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import numpy as np

from datagen.schemas.merging import merge_runs, plan_merge
from datagen.schemas.run_records import LedgerEntry, QuarantineRecord
from datagen.schemas.sealing import RECORD, SEALED, seal
from datagen.schemas.storage import open_storage
from tests.faults.crash_points_operations import remake
from tests.faults.damage_campaign import content, findings_at, repair_at
from tests.made_runs import attempt, files_of, make_run, small_spec, utc_now

PLACES = ("run", "open", "merged")


@dataclass(frozen=True)
class Swap:
    """Two files of the world, by their paths in it, and what sort they are."""

    kind: str
    one: str
    other: str

    @property
    def places(self) -> list[str]:
        """The places that are wrong then."""
        return sorted({self.one.split("/")[0], self.other.split("/")[0]})


@dataclass
class Swaps:
    """How many swaps of each kind there were and what became of them; `wrong` are broken promises."""

    tried: Counter[str] = field(default_factory=Counter[str])
    restored: Counter[str] = field(default_factory=Counter[str])
    set_aside: Counter[str] = field(default_factory=Counter[str])
    left: Counter[str] = field(default_factory=Counter[str])
    wrong: list[str] = field(default_factory=list[str])


def make_world(world: Path) -> None:
    """A sealed run, one that is not, and a sealed place of two runs that want different numbers."""
    _run(world / "run", 29, 0, "r")
    seal(open_storage(world / "run"))
    _run(world / "open", 20, 1, "o")
    for k, seed in enumerate((2, 3)):
        _run(world / f"part-{k}", 10 + 20 * k, seed, f"m{k}")
    merge_runs(plan_merge([str(world / "part-0"), str(world / "part-1")], str(world / "merged")))
    for k in range(2):
        shutil.rmtree(world / f"part-{k}")


def _run(folder: Path, n: int, seed: int, name: str) -> None:
    run = make_run(folder, n - 9, shards=[], spec=small_spec(seed))
    run.grow(n)
    for shard in run.missing():
        assert attempt(run, shard, f"{name}-{shard}")
    for k in range(2):
        run.ledger.start(f"{name}-failed-{k}", k)
        ended = LedgerEntry(
            attempt=f"{name}-failed-{k}", shard=k, outcome="failed", cause=name, ended=utc_now()
        )
        run.ledger.end(ended)
    given_up = QuarantineRecord(
        shard=900,
        seed=seed,
        first_scene=1800,
        scenes=2,
        attempts=(),
        causes=(name,),
        stacks=(),
        created=utc_now(),
    )
    run.quarantine(given_up)


def kind_of(path: str) -> str:
    """The sort of a file among which it is swapped; "" for one that is swapped with none."""
    names = path.split("/")[3 if path.startswith("merged/parts/") else 1 :]
    if names[0] == SEALED:
        return "" if names[-1] == "zarr.json" else "sealed file"
    if names[0].startswith("data"):
        return "store record" if names[0] == RECORD else ""
    if names[0] == "shards":
        return "object"
    if names[0] == "ledger":
        return "start" if names[-1].endswith(".start.json") else "end"
    sort = names[-1] if "manifest.json" in names else names[-2] if len(names) > 1 else ""
    return f"copy of {sort}" if "copies" in names and sort else sort


def swaps(world: Path, each: int | None, rng: np.random.Generator) -> Iterator[Swap]:
    """Pairs of files of one sort that differ: all, or N of each sort."""
    files = files_of(world)
    by_kind: dict[str, list[str]] = {}
    for path in files:
        if kind := kind_of(path):
            by_kind.setdefault(kind, []).append(path)
    for kind, paths in sorted(by_kind.items()):
        pairs = [Swap(kind, a, b) for a, b in combinations(paths, 2) if files[a] != files[b]]
        few = each is not None and len(pairs) > each
        yield from (pairs[k] for k in sorted(rng.choice(len(pairs), each, replace=False))) if few else pairs


def try_swap(clean: Path, world: Path, swap: Swap, found: Swaps) -> None:
    """Exchange two files, check the places that hold them, fix these, and compare everything."""
    shutil.rmtree(world, ignore_errors=True)
    shutil.copytree(clean, world)
    before = files_of(world)
    exchange(world / swap.one, world / swap.other)
    found.tried[swap.kind] += 1

    def wrong(what: str) -> None:
        found.wrong.append(f"{swap.kind}: {swap.one} with {swap.other}: {what}")

    for place in swap.places:
        if not any(finding.kind != "stale" for finding in findings_at(world / place)):
            wrong(f"{place}: missed")
    # All are swapped before one is repaired: a file in another place counts as lost where it belongs.
    repaired = {place: repair_at(world / place) for place in swap.places}
    left = [
        finding
        for each in repaired.values()
        for finding in each.left
        if finding.kind != "stale" and finding.kind != "lost"  # until it is resumed
    ]
    # The ends of attempts whose shards are set aside become superseded.
    there = set(files_of(world).values())
    lost = {path for path, data in before.items() if data not in there}
    if lost := {path for path in lost if "/ledger/" not in path and "/data." not in path}:
        wrong(f"{sorted(lost)[:3]} are nowhere any more")
    for place in swap.places:
        if not left and (repaired[place].set_aside or repaired[place].resealed):
            remake(world / place)
        if not left and findings_at(world / place):
            wrong(f"{place}: not clean after")
    apart = {
        f"{place}/{key}"
        for place in swap.places
        for key, _ in content(world / place).items() ^ content(clean / place).items()
        if place != "open" or not key.startswith("sealed ")  # a repair seals it
    }
    if apart - {swap.one, swap.other} or (apart and not left):
        wrong(f"others differ: {sorted(apart)[:3]}")
    is_aside = any(each.set_aside for each in repaired.values())
    (found.left if left else found.set_aside if is_aside else found.restored)[swap.kind] += 1


def exchange(one: Path, other: Path) -> None:
    """Let two files exchange their names."""
    held = one.with_name("held")
    one.rename(held)
    other.rename(one)
    held.rename(other)

"""Two whole files that exchanged their places: what checks find, and what repair brings back or leaves."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import numpy as np

from datagen.schemas.record_files import MERGED, encode_record, part_folder, publish
from datagen.schemas.run_records import LedgerEntry, Merged, QuarantineRecord
from datagen.schemas.sealing import SEALED, seal
from datagen.schemas.storage import open_storage
from tests.faults.damage_campaign import content, copy_run, findings_at, remake, repair_at
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
    specs = sorted((small_spec(seed) for seed in (2, 3)), key=lambda spec: spec.hash())
    for k, spec in enumerate(specs):
        _run(world / "merged" / part_folder(spec.hash()), 10 + 20 * k, spec.seed, f"m{k}")
    place = open_storage(world / "merged")
    publish(place, MERGED, encode_record(Merged(parts=tuple(spec.hash() for spec in specs))))
    seal(place)


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
        return "" if names[-1] == "zarr.json" else f"sealed {names[1]}"
    if names[0] == "shards":
        return "commit copy" if names[-1] == "commit.json" else "" if len(names) < 5 else f"chunk {names[3]}"
    if names[0] == "ledger":
        return "start" if names[-1].endswith(".start.json") else "end"
    sort = names[-1] if "manifest.json" in names else names[-2] if len(names) > 1 else ""
    return f"copy of {sort}" if "copies" in names and sort else sort


def swaps(world: Path, each: int | None, rng: np.random.Generator) -> Iterator[Swap]:
    """Pairs of files of one sort and, of chunks, of one size, that differ: all, or N of each sort."""
    files = files_of(world)
    by_kind: dict[tuple[str, int], list[str]] = {}
    for path, data in files.items():
        if (kind := kind_of(path)) and "zarr.json" not in path:
            is_chunk = kind.startswith(("chunk", "sealed"))
            by_kind.setdefault((kind, len(data) if is_chunk else 0), []).append(path)
    pairs: dict[str, list[Swap]] = {}
    for (kind, _), paths in sorted(by_kind.items()):
        found = [Swap(kind, a, b) for a, b in combinations(paths, 2) if files[a] != files[b]]
        pairs.setdefault(kind.split(" ")[0] if kind.startswith(("chunk", "sealed")) else kind, []).extend(
            found
        )
    for kind in sorted(pairs):
        chosen = pairs[kind]
        if each is not None and len(chosen) > each:
            chosen = [chosen[k] for k in sorted(rng.choice(len(chosen), each, replace=False))]
        yield from (Swap(kind, swap.one, swap.other) for swap in chosen)


def try_swap(clean: Path, world: Path, swap: Swap, found: Swaps) -> None:
    """Exchange two files, check the places that hold them, fix these, and compare everything."""
    shutil.rmtree(world, ignore_errors=True)
    copy_run(clean, world)
    before = files_of(world)
    exchange(world / swap.one, world / swap.other)
    found.tried[swap.kind] += 1

    def wrong(what: str) -> None:
        found.wrong.append(f"{swap.kind}: {swap.one} with {swap.other}: {what}")

    for place in swap.places:
        if not any(finding.is_damage for finding in findings_at(world / place)):
            wrong(f"{place}: missed")
    # All are swapped before one is repaired: a file in another place counts as lost where it belongs.
    repaired = {place: repair_at(world / place) for place in swap.places}
    left = [finding for each in repaired.values() for finding in each.left if finding.is_damage]
    # The ends of attempts whose shards are set aside become superseded.
    there = set(files_of(world).values())
    lost = {path for path, data in before.items() if data not in there}
    if lost := {path for path in lost if "/ledger/" not in path and SEALED not in path}:
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
        if place != "open" or not key.startswith(SEALED)  # a repair seals it
    }
    if apart - {swap.one, swap.other} or (apart and not left):
        wrong(f"others differ: {sorted(apart)[:3]}")
    kind = (
        found.left
        if left
        else found.set_aside
        if any(r.set_aside for r in repaired.values())
        else found.restored
    )
    kind[swap.kind] += 1


def exchange(one: Path, other: Path) -> None:
    """Let two files exchange their names; other links to them stay."""
    held = one.with_name("held")
    one.rename(held)
    other.rename(one)
    held.rename(other)

"""A run damaged on purpose, one file at a time: found, repaired, resumed, and compared with the original."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from uuid import uuid4

import numpy as np

from datagen.schemas.checking.check_runs import Checked, check_runs
from datagen.schemas.checking.finding import Finding
from datagen.schemas.checking.repair import Repaired, repair_runs
from datagen.schemas.fields import SCHEMAS
from datagen.schemas.record_files import SET_ASIDE
from datagen.schemas.run import Run, open_runs
from datagen.schemas.run_records import LedgerEntry
from datagen.schemas.sealing import seal
from datagen.schemas.storage import open_storage
from tests.faults.crash_points_operations import small_schema
from tests.made_runs import attempt, files_of, make_run, utc_now

# Records without a copy: a damaged one is set aside, or restored from what other records say.
_ALONE = ("ledger/", "quarantine/")


@dataclass(frozen=True)
class Damage:
    """One file, and what is done to its bytes; None removes it."""

    kind: str
    key: str
    change: Callable[[bytes], bytes | None]


@dataclass
class Campaign:
    """How many damages of each kind there were, and those that went wrong."""

    tried: Counter[str] = field(default_factory=Counter[str])
    repaired: Counter[str] = field(default_factory=Counter[str])
    missed: list[str] = field(default_factory=list[str])
    not_restored: list[str] = field(default_factory=list[str])
    not_clean: list[str] = field(default_factory=list[str])

    def rows(self) -> Iterator[tuple[str, int, int, int, int, int]]:
        """(kind, tried, missed, repaired, not restored, not clean after), by kind."""
        for kind in sorted(self.tried):
            counts = [
                sum(one.startswith(f"{kind} ") for one in bad)
                for bad in (self.missed, self.not_restored, self.not_clean)
            ]
            yield kind, self.tried[kind], counts[0], self.repaired[kind], counts[1], counts[2]


@contextmanager
def fewer_arrays() -> Generator[None]:
    """Runs of fewer files meanwhile, of every sort: what is damaged is looked at a thousand times."""
    names = ("scene_index", "redraws", "house_id", "points_m")
    samples = ("sample_id", "sample_scene_index", "candidate_index", "label")
    before = SCHEMAS["heuristic"]
    SCHEMAS["heuristic"] = small_schema((*names, *samples))
    try:
        yield
    finally:
        SCHEMAS["heuristic"] = before


def make_place(
    folder: Path | str, n: int = 19, scenes_per_shard: int = 2, candidates_per_scene: int = 5
) -> Run:
    """A sealed run of few files, whose ledger has waste too."""
    run = make_run(folder, n, scenes_per_shard, candidates_per_scene)
    run.ledger.start("b-0", 0)
    run.ledger.end(LedgerEntry(attempt="b-0", shard=0, outcome="failed", cause="ValueError", ended=utc_now()))
    seal(run.storage)
    return run


def remake(folder: Path) -> None:
    """Make the missing shards, as `datagen resume` does, and seal."""
    storage = open_storage(folder, probe=False, create=False)
    for run in open_runs(storage):
        for shard in run.missing():
            assert attempt(run, shard, f"again-{shard}-{uuid4().hex[:8]}")
    seal(storage)


def content(folder: Path) -> dict[str, bytes]:
    """Root records, the files of shards without the names of their attempts, and the sealed store."""
    found: dict[str, bytes] = {}
    for key, data in files_of(folder).items():
        names = key.split("/")
        if (
            names[0] == SET_ASIDE
            or {"ledger", "commits", "quarantine"} & set(names)
            or "commit.json" in names
        ):
            continue
        if "shards" in names:
            del names[names.index("shards") + 2]
        found["/".join(names)] = data
    return found


def kind_of(key: str) -> str:
    """What sort of file a key names."""
    first, last = key.split("/")[0], key.rsplit("/", 1)[-1]
    if first in ("shards", "data.zarr"):
        sort = "commit copy" if last == "commit.json" else "zarr.json" if last == "zarr.json" else "chunk"
        return f"sealed {sort}" if first == "data.zarr" else sort
    return {"copies": "root copy"}.get(first, first.removesuffix(".json").rstrip("s"))


def flips(folder: Path, count: int, rng: np.random.Generator) -> Iterator[Damage]:
    """Random single bit flips: every sort of file has its share, every byte of a sort the same chance."""
    by_kind: dict[str, list[str]] = {}
    for key in keys_of(folder):
        by_kind.setdefault(kind_of(key), []).append(key)
    kinds = sorted(by_kind)
    for i in range(count):
        keys = by_kind[kinds[i % len(kinds)]]
        sizes = np.array([(folder / key).stat().st_size for key in keys])
        key = keys[int(rng.choice(len(keys), p=sizes / sizes.sum()))]
        bit = int(rng.integers(8 * (folder / key).stat().st_size))
        yield Damage(f"flip {kind_of(key)}", key, lambda data, bit=bit: _flipped(data, bit))


def cuts(folder: Path) -> Iterator[Damage]:
    """Each file in turn removed, cut to nothing, to half, by one byte, and with a byte more."""
    for key in keys_of(folder):
        sort = kind_of(key)
        yield Damage(f"delete {sort}", key, lambda data: None)
        yield Damage(f"empty {sort}", key, lambda data: b"")
        yield Damage(f"halve {sort}", key, lambda data: data[: len(data) // 2])
        yield Damage(f"shorten {sort}", key, lambda data: data[:-1])
        yield Damage(f"append {sort}", key, lambda data: data + b"\0")


def keys_of(folder: Path) -> list[str]:
    """Every file below a folder."""
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


def try_all(
    clean: Path, scratch: Path, damages: Iterable[Damage], campaign: Campaign, repair_every: int = 1
) -> None:
    """Do each damage to a run equal to `clean` and check it; repair every N-th of them, and check again."""
    shutil.rmtree(scratch, ignore_errors=True)
    copy_run(clean, scratch)
    whole = files_of(clean)
    for number, damage in enumerate(damages):
        campaign.tried[damage.kind] += 1
        name = f"{damage.kind} {damage.key}"
        undo = apply(scratch, damage)
        if not [f for f in findings_at(scratch) if f.is_damage]:
            campaign.missed.append(name)
        if number % repair_every:
            undo()
            continue
        campaign.repaired[damage.kind] += 1
        repaired = repair_at(scratch)
        if repaired.left:
            campaign.not_clean.append(f"{name}: {repaired.left[:2]}")
        there = files_of(scratch)
        apart = {key for key in whole.keys() | there.keys() if whole.get(key) != there.get(key)}
        if repaired.set_aside:
            remake(scratch)
            if (left := content(scratch)) != content(clean):
                campaign.not_restored.append(f"{name}: {sorted(left.items() ^ content(clean).items())[:1]}")
        elif apart - ({damage.key} if damage.key.startswith(_ALONE) else set()):
            campaign.not_restored.append(f"{name}: {sorted(apart)[:3]}")
        if left := findings_at(scratch):
            campaign.not_clean.append(f"{name}: {left[:2]}")
        if apart:
            shutil.rmtree(scratch)
            copy_run(clean, scratch)


def copy_run(source: Path, target: Path) -> None:
    """Copy a run with its hard links between data.zarr and the shards."""
    linked: dict[int, Path] = {}
    for path in sorted(source.rglob("*")):
        to = target / path.relative_to(source)
        if path.is_dir():
            to.mkdir(parents=True, exist_ok=True)
            continue
        to.parent.mkdir(parents=True, exist_ok=True)
        inode = path.stat().st_ino
        if inode in linked:
            os.link(linked[inode], to)
        else:
            shutil.copy2(path, to)
            linked[inode] = to


def apply(folder: Path, damage: Damage) -> Callable[[], None]:
    """Change the file in place, so that its hard links change with it, or remove its name; what undoes it."""
    path, held = folder / damage.key, folder.parent / "held"
    before = path.read_bytes()
    data = damage.change(before)
    if data is None:
        path.rename(held)
        return lambda: held.rename(path) and None
    _overwrite(path, data)
    return lambda: _overwrite(path, before)


def _overwrite(path: Path, data: bytes) -> None:
    mode = path.stat().st_mode
    path.chmod(0o644)
    with path.open("r+b") as f:
        f.truncate(0)
        f.write(data)
    path.chmod(mode)


def findings_at(folder: Path) -> list[Finding]:
    """What checks find at a place."""
    return list(check_runs(open_storage(folder, probe=False, create=False), Checked()))


def repair_at(folder: Path) -> Repaired:
    """Repair the run, or the merged runs, in a folder."""
    return repair_runs(open_storage(folder, probe=False, create=False))


def _flipped(data: bytes, bit: int) -> bytes:
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)

"""A run damaged on purpose, one file at a time: found, repaired, resumed, and compared with the original."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from datagen.schemas.checking.check_runs import Checked, check_runs
from datagen.schemas.checking.finding import Finding
from datagen.schemas.checking.repair import Repaired, repair_runs
from datagen.schemas.fields import SCHEMAS
from datagen.schemas.merging import merge_runs, plan_merge
from datagen.schemas.record_files import SET_ASIDE
from datagen.schemas.run import Run, open_runs
from datagen.schemas.run_records import LedgerEntry
from datagen.schemas.sealing import CLAIM, RECORD, SEALED, seal, store_record
from datagen.schemas.storage import open_storage
from tests.faults.crash_points_operations import remake, small_schema
from tests.made_runs import attempt, files_of, make_run, small_spec, utc_now

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


def make_merged(folder: Path) -> None:
    """Merged runs of two specifications, of one of them in shards of two sizes."""
    for name, seed, size, shards in (("a", 1, 1, [2]), ("b", 1, 2, [0]), ("c", 2, 1, [0])):
        run = make_run(folder.parent / name, 12, size, 4, shards=[], spec=small_spec(seed))
        for shard in shards:
            assert attempt(run, shard, f"{name}-{shard}")
    merge_runs(plan_merge([str(folder.parent / name) for name in "abc"], str(folder)))
    remake(folder)


def content(folder: Path) -> dict[str, bytes]:
    """Root records, committed objects by shard, and the sealed store, whatever its name."""
    root = open_storage(folder, probe=False)
    found = {
        key: data
        for key, data in files_of(folder).items()
        if not {*key.split("/")} & {SET_ASIDE, "ledger", "commits", "quarantine", "shards"}
        and key[:4] != "data"
    }
    for run in open_runs(root):
        name = run.storage.url.removeprefix(root.url)
        found |= {f"{name} {one.shard}": run.read_object(one) for one in run.commits()}
    store = store_record(root)
    sealed = files_of(folder / store.name) if store else {}
    return found | {f"sealed {path}": data for path, data in sealed.items()}


def kind_of(key: str) -> str:
    """What sort of file a key names."""
    key = key.split("/", 2)[2] if key.startswith("parts/") else key
    first, last = key.split("/")[0], key.rsplit("/", 1)[-1]
    if first == SEALED:
        return "sealed zarr.json" if last == "zarr.json" else "sealed file"
    kinds = {"copies": "root copy", "shards": "object", RECORD: "store record"}
    return kinds.get(first, first.removesuffix(".json").rstrip("s"))


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
    """Every file below a folder that holds something: a claim is only a name."""
    return sorted(key for key in files_of(folder) if not key.endswith(CLAIM))


def try_all(
    clean: Path, scratch: Path, damages: Iterable[Damage], campaign: Campaign, repair_every: int = 1
) -> None:
    """Do each damage to a run equal to `clean` and check it; repair every N-th of them, and check again."""
    shutil.rmtree(scratch, ignore_errors=True)
    shutil.copytree(clean, scratch)
    whole = files_of(clean)
    for number, damage in enumerate(damages):
        campaign.tried[damage.kind] += 1
        name = f"{damage.kind} {damage.key}"
        undo = apply(scratch, damage)
        if not [f for f in findings_at(scratch) if f.kind != "stale"]:
            campaign.missed.append(name)
        if number % repair_every:
            undo()
            continue
        campaign.repaired[damage.kind] += 1
        repaired = repair_at(scratch)
        is_lost = any(finding.kind == "lost" for finding in repaired.left)
        if any(finding.kind != "lost" for finding in repaired.left):
            campaign.not_clean.append(f"{name}: {repaired.left[:2]}")
        there = files_of(scratch)
        apart = {key for key in whole.keys() | there.keys() if whole.get(key) != there.get(key)}
        if repaired.set_aside or repaired.resealed or is_lost:
            remake(scratch)
            if (left := content(scratch)) != content(clean):
                campaign.not_restored.append(f"{name}: {sorted(left.items() ^ content(clean).items())[:1]}")
        elif apart - ({damage.key} if any(folder in damage.key for folder in _ALONE) else set()):
            campaign.not_restored.append(f"{name}: {sorted(apart)[:3]}")
        if left := findings_at(scratch):
            campaign.not_clean.append(f"{name}: {left[:2]}")
        if apart or is_lost:
            shutil.rmtree(scratch)
            shutil.copytree(clean, scratch)


def apply(folder: Path, damage: Damage) -> Callable[[], None]:
    """Change or remove the file; what undoes it."""
    path = folder / damage.key
    before = path.read_bytes()
    data = damage.change(before)
    if data is None:
        path.unlink()
    else:
        path.write_bytes(data)
    return lambda: path.write_bytes(before) and None


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

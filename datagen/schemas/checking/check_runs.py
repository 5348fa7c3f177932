"""Check a run, or merged runs, one shard at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain

from datagen.schemas.checking.attempts import (
    CheckedShard,
    LedgerTotals,
    check_commit,
    check_ledger,
    check_quarantine,
)
from datagen.schemas.checking.finding import Finding, SetAside, below, curable
from datagen.schemas.checking.roots import check_notes, check_plans, open_roots
from datagen.schemas.checking.sealed import check_store, read_store
from datagen.schemas.checking.shards import check_shard
from datagen.schemas.record_files import object_key
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit
from datagen.schemas.storage import Storage, concurrent_map

_THREADS = 4  # hashing and decompression release the GIL
_REMOTE_THREADS = 16  # requests mostly wait for the server


@dataclass
class Checked:
    """Counts of what was checked, for the report; they grow while findings are consumed."""

    shards: int = 0
    bytes: int = 0
    samples: int = 0
    is_sealed: bool = False
    totals: LedgerTotals = field(default_factory=LedgerTotals)
    runs: list[Run] = field(default_factory=list[Run])
    of_other_code: int = 0  # shards by other code than began their run

    def count(self, commit: Commit) -> None:
        self.shards += 1
        self.bytes += commit.object.size
        self.samples += commit.samples
        self.totals.attempts += 1
        self.totals.committed_wall_s += commit.cost.wall_s


def check_runs(
    storage: Storage, checked: Checked, seen: Callable[[int, int], None] = lambda done, total: None
) -> Iterator[Finding]:
    """Yield every problem in `storage`, as it is found.

    `checked` is filled meanwhile; `seen(done, total)` is called for shards. Every file is read once.
    InputError where there is no run, or one of another format or schema.
    """
    roots = open_roots(storage)
    checked.runs = roots.runs
    found = list(roots.findings)
    for run in roots.runs:
        found += below(roots.folder_of(run), chain(check_plans(run), check_notes(run.storage)))
    if roots.is_merged:
        found += check_notes(storage)
    yield from found
    record, of_store = read_store(storage)
    yield from of_store
    checked.is_sealed = record is not None
    work = [(run, sorted(run.committed())) for run in roots.runs]
    total, done, is_sound = sum(len(shards) for _, shards in work), 0, not found
    threads = _REMOTE_THREADS if storage.folder is None else _THREADS
    with ThreadPoolExecutor(threads) as pool:
        for run, shards in work:
            prefix, committed = roots.folder_of(run), dict[int, str]()
            for looked in concurrent_map(pool, 2 * threads, partial(_look_at, run), shards):
                yield from below(prefix, looked.findings)
                is_sound = is_sound and not looked.findings
                if looked.commit is not None:
                    committed[looked.shard] = looked.commit.attempt
                    checked.count(looked.commit)
                    checked.of_other_code += looked.commit.code_digest != run.manifest.code_digest
                done += 1
                seen(done, total)
            rest = (_check_objects(run), check_ledger(run, committed, checked.totals), check_quarantine(run))
            yield from below(prefix, chain.from_iterable(rest))
    if record is not None:
        yield from check_store(storage, record, roots.runs, is_sound)


def _look_at(run: Run, shard: int) -> CheckedShard:
    """Check one shard: commit, object, rows."""
    found = check_commit(run, shard)
    if found.commit is None:
        return found
    return replace(found, findings=(*found.findings, *check_shard(run, found.commit)))


def _check_objects(run: Run) -> Iterator[Finding]:
    """Other files among the objects; those of attempts that did not commit are garbage, not damage."""
    for file in run.storage.list("shards"):
        name = file.key.removeprefix("shards/")
        if "/" in name or not (name.endswith(".part") or file.key == object_key(name.removesuffix(".zip"))):
            yield curable(file.key, "foreign", "is not the object of an attempt", SetAside())

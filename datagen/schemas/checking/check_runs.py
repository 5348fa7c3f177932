"""Check a run, or merged runs, one shard at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import chain

from datagen.schemas.checking.attempts import (
    CheckedShard,
    LedgerTotals,
    check_account,
    check_commit,
    check_quarantine,
    check_rest,
)
from datagen.schemas.checking.finding import Finding, below
from datagen.schemas.checking.roots import check_notes, check_plans, open_roots
from datagen.schemas.checking.sealed import SealedTally, check_chunks, check_store, read_root, runs_named
from datagen.schemas.checking.shards import ShardForm, check_shard, form_of
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit
from datagen.schemas.sealing.contents import SealedRun
from datagen.schemas.storage import Storage, concurrent_map

_THREADS = 4  # hashing and decompression release the GIL
_REMOTE_THREADS = 16  # requests mostly wait for the server


@dataclass
class Checked:
    """Counts of what was checked, for the report; they grow while findings are consumed."""

    shards: int = 0
    files: int = 0
    bytes: int = 0
    samples: int = 0
    is_sealed: bool = False
    totals: LedgerTotals = field(default_factory=LedgerTotals)
    runs: list[Run] = field(default_factory=list[Run])

    def count(self, commit: Commit) -> None:
        self.shards += 1
        self.files += len(commit.files)
        self.bytes += sum(entry.size for entry in commit.files)
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
    yield from roots.findings
    checked.runs = roots.runs
    wanted: dict[str, int] = {}
    for run in roots.runs:
        wanted[run.manifest.spec_hash], found = check_plans(run)
        yield from below(roots.folder_of(run), chain(found, check_notes(run.storage)))
    if roots.is_merged:
        yield from check_notes(storage)
    root, found = read_root(storage, roots.runs, wanted)
    yield from found
    sealed = runs_named(root, roots.runs) if root else {}
    tally = SealedTally()
    checked.is_sealed = root is not None
    checks = [
        _RunCheck(storage, run, roots.folder_of(run), form_of(run), sealed.get(run.manifest.spec_hash))
        for run in roots.runs
    ]
    work = [(check, check.shards()) for check in checks]
    total, done = sum(len(shards) for _, shards in work), 0
    threads = _REMOTE_THREADS if storage.folder is None else _THREADS
    with ThreadPoolExecutor(threads) as pool:
        for check, shards in work:
            committed: dict[int, str] = {}
            for looked in concurrent_map(pool, 2 * threads, check.look_at, shards):
                yield from looked.findings
                if check.sealed is not None and looked.shard in check.sealed.shards:
                    tally.add(check.sealed, looked)
                if looked.commit is not None:
                    committed[looked.shard] = looked.commit.attempt
                    checked.count(looked.commit)
                done += 1
                seen(done, total)
            yield from check.rest(committed, checked)
    if root is not None:
        yield from check_store(storage, roots.runs, wanted, sealed, tally)


@dataclass(frozen=True, eq=False)
class _RunCheck:
    """Checks of one run, which lies in the folder `prefix` of the checked path."""

    storage: Storage
    run: Run
    prefix: str
    form: ShardForm
    sealed: SealedRun | None  # its part of the store

    def shards(self) -> list[int]:
        return sorted(self.run.committed().union(self.sealed.shards if self.sealed else ()))

    def look_at(self, shard: int) -> CheckedShard:
        """Check one shard: commit, ledger entries, files, rows, and chunks in the sealed store."""
        run, folder = self.run, f"shards/{shard:06d}"
        try:
            listed = {file.key: file for file in run.storage.list(folder)}
        except InputError as error:  # it holds something that is not a file: the shard is not trusted
            key = error.place.removeprefix(f"{run.storage.url}/")
            foreign = [Finding(key, "foreign", error.problem, error.fix, shard)]
            return CheckedShard(shard, None, tuple(below(self.prefix, foreign)))
        found = check_commit(run, shard, listed)
        findings, commit = list(found.findings), found.commit
        if commit is not None:
            findings += check_account(run, commit)
            own = {key: f for key, f in listed.items() if key.startswith(f"{folder}/{commit.attempt}/")}
            findings += check_shard(run, self.form, commit, own)
        findings = list(below(self.prefix, findings))
        if commit is not None and self.sealed is not None and shard in self.sealed.shards:
            findings += check_chunks(self.storage, self.prefix, self.form, self.sealed, commit)
        return replace(found, findings=tuple(findings))

    def rest(self, committed: dict[int, str], checked: Checked) -> Iterator[Finding]:
        """Check the rest of the run: the waste in the ledger, lost commits, the quarantine."""
        totals = checked.totals
        totals.lost_shards = {}
        yield from below(self.prefix, check_rest(self.run, committed, totals))
        for shard in sorted(totals.lost_shards.keys() - set(self.shards())):
            looked = self.look_at(shard)
            yield from looked.findings
            if looked.commit is not None:
                checked.count(looked.commit)
        yield from below(self.prefix, check_quarantine(self.run))

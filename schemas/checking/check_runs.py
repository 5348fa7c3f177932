"""Check a run, or merged runs, one shard at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

from datagen.schemas.checking.commits import check_account, check_commit
from datagen.schemas.checking.finding import Finding
from datagen.schemas.checking.ledger import LedgerTotals, check_quarantine, check_rest
from datagen.schemas.checking.roots import below, check_notes, check_plans, open_roots
from datagen.schemas.checking.sealed import (
    SealedSlice,
    SealedTally,
    check_chunks,
    check_store,
    read_root,
    slices_of,
)
from datagen.schemas.checking.shards import ShardForm, check_shard, form_of
from datagen.schemas.concurrent_map import concurrent_map
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.run_records import Commit
from datagen.schemas.storage import Storage

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


@dataclass(frozen=True, eq=False)
class _CheckedRun:
    """One run, and the data shared by all checks of its shards."""

    place: Storage
    run: Run
    prefix: str
    form: ShardForm
    slice_: SealedSlice | None


@dataclass(frozen=True, eq=False)
class _CheckedShard:
    """The result for one shard."""

    shard: int
    commit: Commit | None
    findings: list[Finding]


def check_runs(
    place: Storage, checked: Checked, seen: Callable[[int, int], None] = lambda done, total: None
) -> Iterator[Finding]:
    """Yield every problem at `place`, as it is found.

    `checked` is filled meanwhile; `seen(done, total)` is called for shards. Every file is read once.
    InputError where there is no run, or one of another format or schema.
    """
    roots = open_roots(place)
    yield from roots.findings
    checked.runs = roots.runs
    wanted: dict[str, int] = {}
    for run in roots.runs:
        wanted[run.manifest.spec_hash], found = check_plans(run)
        yield from (below(roots.folder_of(run), finding) for finding in found)
        yield from (below(roots.folder_of(run), finding) for finding in check_notes(run.storage))
    if roots.is_merged:
        yield from check_notes(place)
    root, found = read_root(place, roots.runs, wanted)
    yield from found
    slices = slices_of(root, roots.runs) if root else {}
    tally = SealedTally()
    checked.is_sealed = root is not None
    work = [(run, _shards_of(run, slices.get(run.manifest.spec_hash))) for run in roots.runs]
    total, done = sum(len(shards) for _, shards in work), 0
    threads = _REMOTE_THREADS if place.folder is None else _THREADS
    with ThreadPoolExecutor(threads) as pool:
        for run, shards in work:
            prefix = roots.folder_of(run)
            slice_ = slices.get(run.manifest.spec_hash)
            subject = _CheckedRun(place, run, prefix, form_of(run), slice_)
            committed: dict[int, str] = {}
            for looked in concurrent_map(
                pool, 2 * threads, lambda shard, s=subject: _look_at(s, shard), shards
            ):
                yield from looked.findings
                if slice_ is not None and looked.shard in slice_.positions:
                    tally.add(run, slice_, looked.shard, looked.commit, bool(looked.findings))
                if looked.commit is not None:
                    committed[looked.shard] = looked.commit.attempt
                    _count(checked, looked.commit)
                done += 1
                seen(done, total)
            yield from _rest(subject, committed, checked)
    if root is not None:
        yield from check_store(place, roots.runs, wanted, slices, tally)


def _shards_of(run: Run, slice_: SealedSlice | None) -> list[int]:
    """Shards that are committed or in the sealed store."""
    return sorted(run.committed() | (slice_.positions.keys() if slice_ else set()))


def _look_at(subject: _CheckedRun, shard: int) -> _CheckedShard:
    """Check one shard: commit, ledger entries, files, rows, and chunks in the sealed store."""
    run, prefix = subject.run, subject.prefix
    folder = f"shards/{shard:06d}"
    try:
        listed = {file.key: file for file in run.storage.list(folder)}
    except InputError as error:  # it holds something that is not a file: the shard is not trusted
        key = error.place.removeprefix(f"{run.storage.url}/")
        return _CheckedShard(
            shard, None, [below(prefix, Finding(key, "foreign", error.problem, error.fix, shard))]
        )
    found = check_commit(run, shard, listed)
    findings, commit = list(found.findings), found.commit
    if commit is not None:
        findings += check_account(run, commit)
        own = {key: f for key, f in listed.items() if key.startswith(f"{folder}/{commit.attempt}/")}
        findings += check_shard(run, subject.form, commit, own)
    findings = [below(prefix, finding) for finding in findings]
    if commit is not None and subject.slice_ is not None and shard in subject.slice_.positions:
        findings += check_chunks(subject.place, prefix, run, subject.form, subject.slice_, commit)
    return _CheckedShard(shard, commit, findings)


def _rest(subject: _CheckedRun, committed: dict[int, str], checked: Checked) -> Iterator[Finding]:
    """Check the rest of a run: the waste in the ledger, lost commits, the quarantine."""
    run, prefix, totals = subject.run, subject.prefix, checked.totals
    totals.lost_shards = {}
    yield from (below(prefix, finding) for finding in check_rest(run, committed, totals))
    for shard in sorted(totals.lost_shards.keys() - set(_shards_of(run, subject.slice_))):
        looked = _look_at(subject, shard)
        yield from looked.findings
        if looked.commit is not None:
            _count(checked, looked.commit)
    yield from (below(prefix, finding) for finding in check_quarantine(run))


def _count(checked: Checked, commit: Commit) -> None:
    checked.shards += 1
    checked.files += len(commit.files)
    checked.bytes += sum(entry.size for entry in commit.files)
    checked.samples += commit.samples
    checked.totals.attempts += 1
    checked.totals.committed_wall_s += commit.cost.wall_s

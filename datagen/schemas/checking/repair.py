"""Repair the findings of checks: from second copies, from other records, or by making shards again.

Every file is replaced by one atomic put of verified bytes, so that an interrupted repair can be run again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from hashlib import sha256

from datagen.schemas.checking.check_runs import Checked, check_runs
from datagen.schemas.checking.finding import Finding, Regenerate, Reseal, Restore
from datagen.schemas.checking.roots import open_roots
from datagen.schemas.checking.sealed import read_root, runs_named
from datagen.schemas.checking.shards import form_of
from datagen.schemas.concurrent_map import concurrent_map
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.run_records import FileEntry
from datagen.schemas.sealing import SEALED, seal
from datagen.schemas.sealing.contents import SealedRun, read_contents
from datagen.schemas.sealing.metadata import ROOT
from datagen.schemas.shard_files import chunk_key
from datagen.schemas.shard_reading import ShardPlace
from datagen.schemas.storage import Storage, StoredFile

# Repairing a record reveals what depends on it: commits, then files, then the sealed store.
_PASSES = 5
# Kinds of findings that leave the set of rows undecided.
_UNDECIDED = ("record", "lost", "foreign", "sealed")

_BadFile = tuple[Finding, Regenerate]
RegenerateShard = Callable[[Run, int], Mapping[str, bytes]]
Seen = Callable[[int, int], None]


@dataclass
class Repaired:
    """The result of a repair."""

    records: list[str] = field(default_factory=list[str])  # keys of the written files
    copied_files: list[str] = field(default_factory=list[str])
    regenerated_files: list[str] = field(default_factory=list[str])
    regenerated_shards: list[int] = field(default_factory=list[int])
    sealed_files: list[str] = field(default_factory=list[str])
    resealed: bool = False
    left: list[Finding] = field(default_factory=list[Finding])
    checked: Checked = field(default_factory=Checked)
    untouched: int = 0  # files with unchanged time and size; their digests were checked
    changed: list[str] = field(default_factory=list[str])  # others that another process changed meanwhile

    @property
    def written(self) -> set[str]:
        return {*self.records, *self.copied_files, *self.regenerated_files, *self.sealed_files}


def repair_runs(
    storage: Storage, regenerate: RegenerateShard, workers: int = 1, seen: Seen = lambda done, total: None
) -> Repaired:
    """Check, repair what can be repaired, and check again, until no more can be repaired.

    `regenerate` returns all files of a shard by path, or raises; with more `workers` several shards are made
    concurrently. A regenerated file is written only if all bad files of its shard have the committed digests.
    The result holds the remaining findings. InputError as `check_runs`.
    """
    repair = _Repair(storage, regenerate, workers)
    repaired = repair.result
    before = {file.key: _state(file) for file in storage.list("")}
    for _ in range(_PASSES):
        if not repair.run_pass(seen):
            break

    def is_ours(key: str) -> bool:
        return key in written or (repaired.resealed and key.startswith(f"{SEALED}/"))

    written = repaired.written
    for file in storage.list(""):  # a second dictionary of all files of a large run would not fit into memory
        state = before.pop(file.key, None)
        if state is None or is_ours(file.key):
            continue
        if state == _state(file):
            repaired.untouched += 1
        else:
            repaired.changed.append(file.key)
    repaired.changed += [key for key in before if not is_ours(key)]
    return repaired


def _state(file: StoredFile) -> int:
    """Time of change and size of a file as one number; links to it do not change it."""
    return hash((file.modified_s, file.size))


@dataclass
class _Repair:
    """A repair in several passes. `refused` has the reason why a file, or the sealed store, is skipped."""

    storage: Storage
    regenerate: RegenerateShard
    workers: int
    result: Repaired = field(default_factory=Repaired)
    refused: dict[str, str] = field(default_factory=dict[str, str])

    def run_pass(self, seen: Seen) -> bool:
        """Check once and repair the findings; return whether any was repaired."""
        result = self.result
        result.checked, result.left = Checked(), []
        bad: dict[tuple[str, int], list[_BadFile]] = {}
        sealed: list[Finding] = []
        done = False
        for finding in check_runs(self.storage, result.checked, seen):
            cure = finding.cure
            if isinstance(cure, Restore):
                done |= self._put(finding, cure.data, result.records, cure.is_guess)
            elif isinstance(cure, Regenerate) and finding.key not in self.refused:
                bad.setdefault((cure.run.storage.url, cure.shard), []).append((finding, cure))
            elif isinstance(cure, Reseal) and SEALED not in self.refused:
                sealed.append(finding)
            else:
                self._leave(finding)
        files = self._repair_files(bad.values()) if bad else 0
        relink = bool(files) and result.checked.is_sealed and self.storage.folder is not None
        if any(finding.kind in _UNDECIDED for finding in result.left):
            why = "Repair the other findings first: the run cannot be sealed before"
            result.left += [replace(finding, fix=why, cure=None) for finding in sealed]
        elif sealed or relink:
            done |= self._repair_sealed(sealed)
        return done or bool(files)

    def _leave(self, finding: Finding) -> None:
        """List a finding as left, with the reason why its repair was refused."""
        why = self.refused.get(SEALED if isinstance(finding.cure, Reseal) else finding.key)
        self.result.left.append(finding if why is None else replace(finding, fix=why, cure=None))

    def _put(self, finding: Finding, data: bytes, noted: list[str], is_guess: bool = False) -> bool:
        """Write the restored bytes; return whether it succeeded. A guess replaces no existing file."""
        if finding.key not in self.refused:
            try:
                is_put = True
                if is_guess:
                    is_put = self.storage.put_new(finding.key, data)
                else:
                    self.storage.put(finding.key, data)
                    self.storage.sync([finding.key])
                noted += [finding.key] * is_put
                return True
            except InputError as error:
                self.refused[finding.key] = f"{error.problem}. {error.fix}"
        self._leave(finding)
        return False

    def _repair_files(self, bad: Iterable[list[_BadFile]]) -> int:
        """Restore files of shards from the sealed store, from the schema, or regenerated; count them."""
        sealed, put = self._sealed_runs(), 0
        to_make: list[list[_BadFile]] = []
        for files in bad:
            rest: list[_BadFile] = []
            for finding, cure in files:
                data = _second_source(self.storage, sealed.get(cure.run.manifest.spec_hash), cure)
                if data is None:
                    rest.append((finding, cure))
                else:
                    put += self._put(finding, data, self.result.copied_files)
            if rest:
                to_make.append(rest)
        for files, made in self._regenerated(to_make):
            if isinstance(made, str):
                self.refused |= {finding.key: made for finding, _ in files}
                for finding, _ in files:
                    self._leave(finding)
            else:
                for finding, cure in files:
                    put += self._put(finding, made[cure.entry.path], self.result.regenerated_files)
                self.result.regenerated_shards.append(files[0][1].shard)
        return put

    def _sealed_runs(self) -> Mapping[str, SealedRun]:
        runs = open_roots(self.storage).runs
        root, _ = read_root(self.storage, runs, {run.manifest.spec_hash: run.n for run in runs})
        return runs_named(root, runs) if root else {}

    def _regenerated(
        self, to_make: list[list[_BadFile]]
    ) -> Iterator[tuple[list[_BadFile], Mapping[str, bytes] | str]]:
        """Yield each shard's bad files with its regenerated files, or with the reason not to write them."""

        def make(files: list[_BadFile]) -> Mapping[str, bytes] | str:
            _, first = files[0]
            try:
                made = self.regenerate(first.run, first.shard)
            except InputError as error:
                return str(error)
            except Exception as error:  # noqa: BLE001 - a simulator's failure concerns this shard alone
                return f"Making the shard again failed ({type(error).__name__}: {error})"
            if all(_has_digest(made.get(cure.entry.path), cure.entry) for _, cure in files):
                return made
            return "Restore the file from a backup: on this machine the remade shard has other bytes"

        if self.workers <= 1 or len(to_make) <= 1:
            yield from ((files, make(files)) for files in to_make)
            return
        with ThreadPoolExecutor(self.workers) as pool:
            # Bounds the number of results in memory.
            yield from zip(to_make, concurrent_map(pool, self.workers, make, to_make), strict=True)

    def _repair_sealed(self, findings: list[Finding]) -> bool:
        """Repair the sealed store: at once where one rename does it, else file by file."""
        roots = {SEALED, f"{SEALED}/{ROOT}"}
        try:
            _refuse_fewer_rows(self.storage)
            if self.storage.folder is not None or any(
                f.key in roots and isinstance(f.cure, Reseal) and f.cure.data is None for f in findings
            ):
                seal(self.storage)
                self.result.resealed = True
                return True
            # The root last: it makes the store readable.
            for finding in sorted(findings, key=lambda f: f.key in roots):
                if isinstance(finding.cure, Reseal):
                    _repair_one(self.storage, finding.key, finding.cure)
                    self.result.sealed_files.append(finding.key)
        except InputError as error:
            self.refused[SEALED] = str(error)
            for finding in findings:
                self._leave(finding)
            return False
        return True


def _second_source(storage: Storage, sealed: SealedRun | None, cure: Regenerate) -> bytes | None:
    """The committed bytes of a file where they can be restored without making the shard again."""
    entry, form = cure.entry, form_of(cure.run)
    if _has_digest(data := form.metadata.get(entry.path), entry):
        return data
    name = entry.path.split("/")[0]
    paths = form.chunks.get(name, ())
    if sealed is None or cure.shard not in sealed.shards or entry.path not in paths:
        return None
    if entry.size > form.most_bytes(entry.path):
        return None
    number = sealed.position_of(cure.shard) * len(paths) + paths.index(entry.path)
    array = next(f for _, f in form.schema.fields if f.name == name)
    try:
        data = storage.get(f"{SEALED}/{name}/{chunk_key(array, number)}", entry.size)
    except InputError:
        return None
    return data if _has_digest(data, entry) else None


def _has_digest(data: bytes | None, entry: FileEntry) -> bool:
    return data is not None and len(data) == entry.size and sha256(data).hexdigest() == entry.sha256


def _refuse_fewer_rows(storage: Storage) -> None:
    """Raise InputError where sealing would drop rows that all arrays of the store have."""
    contents = read_contents(storage, check=False)
    names = [field.name for field in contents.schema.sample_fields]
    try:
        sealed = ShardPlace(storage, SEALED, 0, 0, 0, 0, 0).metadata(names)
        held = min(array.shape[0] for array in sealed.values())
    except InputError:
        return  # a damaged store does not count
    if (rows := contents.rows("sample")) < held:
        problem = f"has {held} samples, but {rows} are committed and wanted"
        fix = "Restore the plans or commits of its shards, or remove it with `datagen unseal`"
        raise InputError(f"{storage.url}/{SEALED}", "", problem, fix)


def _repair_one(storage: Storage, key: str, cure: Reseal) -> None:
    if cure.source:
        storage.adopt(storage, cure.source, key)
    elif cure.data is not None:
        storage.put(key, cure.data)
    else:
        storage.delete([key])

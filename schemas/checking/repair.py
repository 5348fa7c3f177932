"""Repair the findings of checks: from second copies, from other records, or by making shards again.

Every file is replaced by one atomic put of verified bytes, so that an interrupted repair can be run again.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from hashlib import sha256

from datagen.schemas.checking.check_runs import Checked, check_runs
from datagen.schemas.checking.finding import Finding, Regenerate, Reseal, Restore
from datagen.schemas.checking.roots import open_roots
from datagen.schemas.checking.sealed import SealedSlice, read_root, slices_of
from datagen.schemas.checking.shards import form_of
from datagen.schemas.concurrent_map import concurrent_map
from datagen.schemas.errors import InputError
from datagen.schemas.run import Run
from datagen.schemas.run_records import FileEntry
from datagen.schemas.sealing import SEALED, seal
from datagen.schemas.sealing.contents import read_contents
from datagen.schemas.sealing.metadata import ROOT
from datagen.schemas.shard_files import chunk_key
from datagen.schemas.shard_reading import ShardPlace
from datagen.schemas.storage import Storage, StoredFile

# Repairing a record reveals what depends on it: commits, then files, then the sealed store.
_PASSES = 5
# Findings that decide which rows there are.
_UNDECIDED = ("record", "lost", "foreign", "sealed")

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
        """Keys of all written files."""
        return {*self.records, *self.copied_files, *self.regenerated_files, *self.sealed_files}


def repair_runs(
    place: Storage, regenerate: RegenerateShard, workers: int = 1, seen: Seen = lambda done, total: None
) -> Repaired:
    """Check, repair what can be repaired, and check again, until no more can be repaired.

    `regenerate` returns all files of a shard by path, or raises; with more `workers` several shards are made
    concurrently. A regenerated file is written only if all bad files of its shard have the committed digests.
    The result holds the remaining findings. InputError as `check_runs`.
    """
    repaired = Repaired()
    before = {file.key: _state(file) for file in place.list("")}
    refused: dict[str, str] = {}  # key -> reason; not tried again
    for _ in range(_PASSES):
        found = _pass(place, regenerate, workers, seen, repaired, refused)
        if not found:
            break
    written = repaired.written
    for file in place.list(""):  # a second dictionary of all files would not fit into memory for a large run
        state = before.pop(file.key, None)
        if state is None or _is_ours(file.key, written, repaired.resealed):
            continue
        if state == _state(file):
            repaired.untouched += 1
        else:
            repaired.changed.append(file.key)
    repaired.changed += [key for key in before if not _is_ours(key, written, repaired.resealed)]
    return repaired


def _state(file: StoredFile) -> int:
    """Time of change and size of a file as one number; links to it do not change it."""
    return hash((file.modified_s, file.size))


def _is_ours(key: str, written: Container[str], resealed: bool) -> bool:
    return key in written or (resealed and key.startswith(f"{SEALED}/"))


def _pass(
    place: Storage,
    regenerate: RegenerateShard,
    workers: int,
    seen: Seen,
    repaired: Repaired,
    refused: dict[str, str],
) -> bool:
    """Check once and repair the findings; return whether any was repaired."""
    repaired.checked, repaired.left = Checked(), []
    bad: dict[tuple[str, int], list[Finding]] = {}
    sealed: list[Finding] = []
    done = False
    for finding in check_runs(place, repaired.checked, seen):
        cure = finding.cure
        if isinstance(cure, Restore):
            done |= _put(place, finding, cure.data, repaired.records, repaired, refused, cure.is_guess)
        elif isinstance(cure, Regenerate) and finding.key not in refused:
            bad.setdefault((cure.run.storage.url, cure.shard), []).append(finding)
        elif isinstance(cure, Reseal) and SEALED not in refused:
            sealed.append(finding)
        else:
            repaired.left.append(_refused(finding, refused))
    files = 0
    if bad:
        files = _repair_files(place, regenerate, workers, bad, repaired, refused)
    relink = bool(files) and repaired.checked.is_sealed and place.folder is not None
    if any(finding.kind in _UNDECIDED for finding in repaired.left):
        why = "Repair the other findings first: the run cannot be sealed before"
        repaired.left += [replace(finding, fix=why, cure=None) for finding in sealed]
    elif sealed or relink:
        done |= _repair_sealed(place, sealed, repaired, refused)
    return done or bool(files)


def _refused(finding: Finding, refused: Mapping[str, str]) -> Finding:
    why = refused.get(SEALED if isinstance(finding.cure, Reseal) else finding.key)
    if why is None:
        return finding
    return Finding(finding.key, finding.kind, finding.problem, why, finding.shard)


def _put(
    place: Storage,
    finding: Finding,
    data: bytes,
    noted: list[str],
    repaired: Repaired,
    refused: dict[str, str],
    is_guess: bool = False,
) -> bool:
    """Write the restored bytes; return whether a file changed. A guess does not replace an existing file."""
    if finding.key not in refused:
        try:
            if is_guess:
                is_put = place.put_new(finding.key, data)
            else:
                place.put(finding.key, data)
                place.sync([finding.key])
                is_put = True
        except InputError as error:
            refused[finding.key] = f"{error.problem}. {error.fix}"
        else:
            noted += [finding.key] * is_put
            return True
    repaired.left.append(_refused(finding, refused))
    return False


def _repair_files(
    place: Storage,
    regenerate: RegenerateShard,
    workers: int,
    bad: Mapping[tuple[str, int], list[Finding]],
    repaired: Repaired,
    refused: dict[str, str],
) -> int:
    """Restore files of shards from the sealed store, from the schema, or regenerated; return their number."""
    slices, put = _slices(place), 0
    to_make: list[tuple[Run, int, list[Finding]]] = []
    for (_, shard), findings in bad.items():
        rest: list[Finding] = []
        for finding in findings:
            data = _second_source(place, slices, finding)
            if data is None:
                rest.append(finding)
            else:
                put += _put(place, finding, data, repaired.copied_files, repaired, refused)
        if rest and isinstance(rest[0].cure, Regenerate):
            to_make.append((rest[0].cure.run, shard, rest))
    for _, shard, findings, files in _regenerated(regenerate, to_make, workers):
        why = files if isinstance(files, str) else _unlike(findings, files)
        for finding in findings:
            if why:
                refused[finding.key] = why
                repaired.left.append(_refused(finding, refused))
            elif isinstance(finding.cure, Regenerate) and not isinstance(files, str):
                data = files[finding.cure.entry.path]
                put += _put(place, finding, data, repaired.regenerated_files, repaired, refused)
        if not why:
            repaired.regenerated_shards.append(shard)
    return put


def _slices(place: Storage) -> Mapping[str, SealedSlice]:
    """Shards in the sealed store, by specification hash."""
    runs = open_roots(place).runs
    root, _ = read_root(place, runs, {run.manifest.spec_hash: run.n for run in runs})
    return slices_of(root, runs) if root else {}


def _second_source(place: Storage, slices: Mapping[str, SealedSlice], finding: Finding) -> bytes | None:
    """The committed bytes of a file where they can be restored without making the shard again."""
    cure = finding.cure
    if not isinstance(cure, Regenerate):
        return None
    run, entry = cure.run, cure.entry
    form = form_of(run)
    data = form.metadata.get(entry.path)
    if data is not None and _has_digest(data, entry):
        return data
    slice_ = slices.get(run.manifest.spec_hash)
    if slice_ is None or cure.shard not in slice_.positions:
        return None
    name = entry.path.split("/")[0]
    fields = {f.name: f for f in (*form.schema.scene_fields, *form.schema.sample_fields)}
    paths = form.chunks.get(name, ())
    if entry.path not in paths or entry.size > form.most_bytes(entry.path):
        return None
    number = slice_.positions[cure.shard] * len(paths) + paths.index(entry.path)
    try:
        data = place.get(f"{SEALED}/{name}/{chunk_key(fields[name], number)}", entry.size)
    except InputError:
        return None
    return data if data is not None and _has_digest(data, entry) else None


def _has_digest(data: bytes, entry: FileEntry) -> bool:
    return len(data) == entry.size and sha256(data).hexdigest() == entry.sha256


def _regenerated(
    regenerate: RegenerateShard, to_make: Iterable[tuple[Run, int, list[Finding]]], workers: int
) -> Iterator[tuple[Run, int, list[Finding], Mapping[str, bytes] | str]]:
    """Yield each shard with its regenerated files, or with the reason why there are none."""

    def make(one: tuple[Run, int, list[Finding]]) -> Mapping[str, bytes] | str:
        try:
            return regenerate(one[0], one[1])
        except InputError as error:
            return str(error)
        except Exception as error:  # noqa: BLE001 - a simulator's failure concerns this shard alone
            return f"Making the shard again failed ({type(error).__name__}: {error})"

    shards = list(to_make)
    if workers <= 1 or len(shards) <= 1:
        yield from ((*one, make(one)) for one in shards)
        return
    with ThreadPoolExecutor(workers) as pool:
        # Bounds the number of results in memory.
        for one, files in zip(shards, concurrent_map(pool, workers, make, shards), strict=True):
            yield (*one, files)


def _unlike(findings: Iterable[Finding], files: Mapping[str, bytes]) -> str:
    """Why regenerated files must not be written, or ""."""
    for finding in findings:
        if isinstance(finding.cure, Regenerate):
            data = files.get(finding.cure.entry.path)
            if data is None or not _has_digest(data, finding.cure.entry):
                return "Restore the file from a backup: on this machine the remade shard has other bytes"
    return ""


def _repair_sealed(
    place: Storage, findings: list[Finding], repaired: Repaired, refused: dict[str, str]
) -> bool:
    """Repair the sealed store: at once where one rename does it, else file by file."""
    roots = {SEALED, f"{SEALED}/{ROOT}"}
    try:
        _refuse_fewer_rows(place)
        if place.folder is not None or any(
            f.key in roots and isinstance(f.cure, Reseal) and f.cure.data is None for f in findings
        ):
            seal(place)
            repaired.resealed = True
            return True
        # The root last: it makes the store readable.
        for finding in sorted(findings, key=lambda f: f.key in roots):
            if isinstance(finding.cure, Reseal):
                _repair_one(place, finding.key, finding.cure)
                repaired.sealed_files.append(finding.key)
    except InputError as error:
        refused[SEALED] = str(error)
        repaired.left += [_refused(finding, refused) for finding in findings]
        return False
    return True


def _refuse_fewer_rows(place: Storage) -> None:
    """Raise InputError where sealing would drop rows that all arrays of the store have."""
    contents = read_contents(place, check=False)
    names = [field.name for field in contents.schema.sample_fields]
    try:
        sealed = ShardPlace(place, SEALED, 0, 0, 0, 0, 0).metadata(names)
        held = min(array.shape[0] for array in sealed.values())
    except InputError:
        return  # a damaged store does not count
    if (rows := contents.rows("sample")) < held:
        problem = f"has {held} samples, but {rows} are committed and wanted"
        fix = "Restore the plans or commits of its shards, or remove it with `datagen unseal`"
        raise InputError(f"{place.url}/{SEALED}", "", problem, fix)


def _repair_one(place: Storage, key: str, cure: Reseal) -> None:
    if cure.source:
        place.link_or_copy(cure.source, key)
    elif cure.data is not None:
        place.put(key, cure.data)
    else:
        place.delete([key])

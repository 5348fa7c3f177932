"""Checks of the records at the root of a run, or of merged runs, with their second copies."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from datagen.schemas.checking.finding import (
    AnyRecord,
    Finding,
    SetAside,
    below,
    compare,
    curable,
    read,
    sound,
)
from datagen.schemas.errors import InputError
from datagen.schemas.record_files import MERGED, copy_key, refuse_other_format
from datagen.schemas.run import Run
from datagen.schemas.run_records import (
    FORMAT_VERSION,
    Commit,
    Manifest,
    Merged,
    MergedPart,
    Plan,
    other_value,
)
from datagen.schemas.shard_ranges import ShardRanges
from datagen.schemas.storage import Storage

_MANIFEST = "manifest.json"
_BROKEN_OFF = "Merge the runs again: it finishes a merge that was interrupted"


@dataclass
class Roots:
    """The runs at a path that can be opened, and findings on the records at its root."""

    url: str
    runs: list[Run] = field(default_factory=list[Run])
    is_merged: bool = False
    findings: list[Finding] = field(default_factory=list[Finding])

    def folder_of(self, run: Run) -> str:
        """The run's folder relative to the path, with a trailing slash."""
        return f"{run.storage.url.removeprefix(self.url)}/".lstrip("/") if self.is_merged else ""


def open_roots(storage: Storage) -> Roots:
    """Open the run, or the parts, in `storage` from undamaged copies of the records.

    InputError where there is no run, or one of another format.
    """
    parts, findings = _merged_parts(storage)
    if parts is None:
        run, found = _open_run(storage)
        if run is None and not found:
            raise InputError(storage.url, _MANIFEST, "not a run: no such file", "Name a run's folder")
        return Roots(storage.url, [run] if run else [], False, found)
    roots = Roots(storage.url, [], True, findings)
    for part in parts:
        run, found = None, list[Finding]()
        if next(iter(storage.list(part.folder)), None) is not None:
            run, found = _open_run(storage.below(part.folder), part.spec_hash)
        if run is None and not found:
            found = [Finding(_MANIFEST, "record", "missing, as is its copy", "Merge the runs again")]
        roots.findings += below(f"{part.folder}/", found)
        if run is not None:
            roots.runs.append(Run(run.storage, run.manifest, ShardRanges.between(part.scenes)))
    return roots


def _merged_parts(storage: Storage) -> tuple[tuple[MergedPart, ...] | None, list[Finding]]:
    """The parts, or None where these are not merged runs."""
    ours, copy = read(storage, MERGED, Merged), read(storage, copy_key(MERGED), Merged)
    merged = sound(ours, copy)
    if merged is not None:
        refuse_other_format(f"{storage.url}/{MERGED}", merged.format_version)
        return merged.parts, compare(ours, copy, fix=_BROKEN_OFF)
    if ours.problem == copy.problem == "missing":
        return None, []
    return (), compare(ours, copy)


def _open_run(storage: Storage, spec_hash: str | None = None) -> tuple[Run | None, list[Finding]]:
    """Open the run; it must have this specification where one is given."""

    def refuse(manifest: Manifest) -> str:
        if spec_hash not in (None, manifest.spec_hash):
            return "belongs to another run"
        if manifest.format_version == FORMAT_VERSION and manifest.spec.hash() != manifest.spec_hash:
            return "spec_hash: is not the hash of the specification in the record"
        return ""

    ours = read(storage, _MANIFEST, Manifest, refuse)
    copy = read(storage, copy_key(_MANIFEST), Manifest, refuse)
    manifest = sound(ours, copy)
    if ours.record and copy.record and ours.record.spec_hash != copy.record.spec_hash:
        named = _named(storage)
        if len(named) == 1 and named < {ours.record.spec_hash, copy.record.spec_hash}:
            return _open_run(storage, named.pop())
    if manifest is None:
        return None, compare(ours, copy)
    refuse_other_format(f"{storage.url}/{_MANIFEST}", manifest.format_version)
    return Run(storage, manifest), compare(ours, copy)


def _named(storage: Storage) -> set[str]:
    commits = (read(storage, file.key, Commit).record for file in storage.list("commits"))
    plans = (read(storage, file.key, Plan).record for file in storage.list("plans"))
    return {record.spec_hash for record in (*commits, *plans) if record and record.spec_hash}


def check_plans(run: Run) -> list[Finding]:
    """Check plans: each has its copy, and a larger n than the last."""
    findings: list[Finding] = []
    numbers = {0}
    for folder in ("plans", copy_key("plans")):
        for file in run.storage.list(folder):
            name = file.key.removeprefix(f"{folder}/").removesuffix(".json")
            if name.isascii() and name.isdigit() and len(name) < 10 and f"{folder}/{name}.json" == file.key:
                numbers.add(int(name))
    n = 0
    fix = "Restore the file from a backup, or set the number again with `datagen resume RUN --n N`"
    if max(numbers) > 10 * len(numbers) + 1000:
        problem = f"plan {max(numbers)} among {len(numbers)} files"
        return [Finding("plans", "record", problem, "Move it out of the run")]
    for number in range(1, max(numbers) + 1):
        key, expected = f"plans/{number}.json", {"spec_hash": run.manifest.spec_hash, "number": number}
        ours, copy = (
            read(run.storage, k, Plan, lambda plan, e=expected: ": ".join(other_value(plan, **e) or ()))
            for k in (key, copy_key(key))
        )
        found, plan = compare(ours, copy), sound(ours, copy)
        if plan is None and not found:
            found = [Finding(key, "record", "missing, as is its copy", fix)]
        elif plan is not None and plan.n <= n:
            problem = f"n: {plan.n} is not more than in the plan before"
            found.append(Finding(key, "record", problem, "Remove the plan"))
        findings += found
        n = max(n, plan.n if plan else 0)
    if not n:
        findings.append(Finding("plans", "record", "has no plan with the number of samples wanted", fix))
    return findings


def check_notes(storage: Storage) -> Iterator[Finding]:
    """Check the records of jobs, on which no row depends; their states may be torn by a power cut."""
    for file in storage.list("jobs"):
        is_record = file.key.endswith(".json") and not file.key.endswith(".state.json")
        if is_record and (problem := read(storage, file.key, AnyRecord).problem):
            yield curable(file.key, "record", problem, SetAside())

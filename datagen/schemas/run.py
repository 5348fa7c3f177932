"""A run on disk: manifest, plans, shards, commits, ledger and quarantine (docs/reference/data-format.md).

The rows of an attempt are one immutable object. Readers, resume, seal and audit trust only commit records: a
commit is written last and create-only, so that of two racing attempts one wins and the other is waste.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from hashlib import sha256
from heapq import merge
from pathlib import Path
from typing import NamedTuple

from datagen.schemas.errors import InputError
from datagen.schemas.fields import OLDEST_SCHEMA, SCHEMA_VERSION, RecordSchema, sized_schema
from datagen.schemas.record_files import (
    MAX_RECORD_BYTES,
    MAX_STACK_CHARS,
    MERGED,
    REPAIR,
    Ledger,
    commit_key,
    decode_record,
    encode_record,
    lost_end,
    object_key,
    publish,
    read_record,
    read_records,
    refuse_foreign,
    refuse_other,
    refuse_other_format,
    utc_now,
)
from datagen.schemas.run_records import (
    MAX_FILE_BYTES,
    Commit,
    Cost,
    FileEntry,
    Host,
    Layout,
    Manifest,
    Merged,
    Plan,
    QuarantineRecord,
    foreign_field,
    other_value,
)
from datagen.schemas.shard_ranges import ShardRanges
from datagen.schemas.storage import Storage, open_storage

MOST_SAMPLES = 10**12  # of a run
_MOST_REMEMBERED = 10_000  # commits, of 3 kB each
_NUMBERED = re.compile(r"([0-9]{1,18})\.json")


def refuse_odd_n(n: int) -> None:
    """Raise InputError for a number of labels out of range."""
    if not 1 <= n <= MOST_SAMPLES:
        raise InputError("--n", str(n), "is not between 1 and 10^12", "Give the number of labels wanted")


class Rows(NamedTuple):
    """The rows of a shard that count: `scenes` from its scene `first` on, and their samples."""

    first: int
    scenes: int
    samples: int


class RunReplaced(InputError):
    """Another run has taken the folder of one that was opened, or it is gone."""


class Run:
    """One run. Cheap to open and to send to another process; holds no lock.

    Make it with `Run.create_or_open` or `Run.open`. `scenes` are those that count in a part of merged runs;
    None for all that are planned.
    """

    def __init__(self, storage: Storage, manifest: Manifest, scenes: ShardRanges | None = None) -> None:
        self.storage = storage
        self.manifest = manifest
        self.scenes = scenes
        self.ledger = Ledger(storage, self.refuse_replaced)
        self._plan: Plan | None = None
        self._remembered: dict[int, Commit] = {}

    def __repr__(self) -> str:
        return f"Run({self.storage.url!r})"

    @classmethod
    def create_or_open(cls, storage: Storage, manifest: Manifest, n: int) -> Run:
        """Create a run of n samples, or open the existing one and grow it to n if it is shorter.

        An existing run keeps its layout. InputError when it has another specification or format, with every
        field that differs, or when the folder holds other files.
        """
        if not storage.exists("manifest.json"):
            refuse_foreign(storage)
            publish(storage, "manifest.json", encode_record(manifest))
        run = cls.open(storage)
        _ = run.schema  # InputError for an unknown version
        refuse_other(storage.url, run.manifest, manifest)
        run.grow(n)
        return run

    @classmethod
    def open(cls, path: Storage | Path | str, scenes: ShardRanges | None = None) -> Run:
        """Open an existing run. InputError where there is none, or it is damaged or of another format."""
        storage = path if isinstance(path, Storage) else open_storage(path, probe=False, create=False)
        manifest = read_record(storage, "manifest.json", Manifest)
        if manifest is None:
            merged = read_record(storage, MERGED, Merged)
            if merged is not None:
                parts = ", ".join(f"{storage.url}/{part.folder}" for part in merged.parts[:3])
                more = f" or another of {len(merged.parts)}" if len(merged.parts) > 3 else ""
                problem = f"holds {len(merged.parts)} merged runs, but one run is needed"
                raise InputError(storage.url, "", problem, f"Name one of its parts: {parts}{more}")
            raise InputError(storage.url, "manifest.json", "not a run: no such file", "Name a run's folder")
        where = f"{storage.url}/manifest.json"
        refuse_other_format(where, manifest.format_version)
        if manifest.spec.hash() != manifest.spec_hash:
            problem = "is not the hash of the specification in the record"
            raise InputError(where, "spec_hash", problem, "The manifest was edited: restore it from a copy")
        return cls(storage, manifest, scenes)

    def refuse_replaced(self) -> None:
        """Raise RunReplaced where this is no longer the run that was opened: before anything is written."""
        stored = read_record(self.storage, "manifest.json", Manifest)
        if stored != self.manifest:
            ours, now = (m and f"run {m.spec_hash[:12]} of {m.created}" for m in (self.manifest, stored))
            problem = f"this job makes {ours}, but the folder now has {now or 'none'}"
            fix = "Give each run its own --out; if ours was moved, resume it there"
            raise RunReplaced(f"{self.storage.url}/manifest.json", "", problem, fix)

    @property
    def layout(self) -> Layout:
        return self.manifest.layout

    @property
    def schema(self) -> RecordSchema:
        """The record schema with the run's axis lengths. InputError for an unknown one."""
        manifest, place = self.manifest, f"{self.storage.url}/manifest.json"
        if not OLDEST_SCHEMA <= manifest.schema_version <= SCHEMA_VERSION:
            problem = (
                f"is {manifest.schema_version}, but this program reads {OLDEST_SCHEMA} to {SCHEMA_VERSION}"
            )
            raise InputError(place, "schema_version", problem, "Use the version of datagen that made the run")
        try:
            return sized_schema(manifest.schema_name, manifest.spec, manifest.schema_version)
        except InputError as e:
            raise InputError(place, e.field, e.problem, e.fix) from e

    # Plans: the number of samples wanted.

    @property
    def n(self) -> int:
        plan = self.plan()
        return plan.n if plan else 0

    def grow(self, n: int, created: str | None = None) -> None:
        """Raise the wanted samples to n; a run never shrinks. `created` is the plan's time [now]."""
        refuse_odd_n(n)
        while (newest := self.plan()) is None or newest.n < n:
            number, spec_hash = newest.number + 1 if newest else 1, self.manifest.spec_hash
            plan = Plan(n=n, created=created or utc_now(), spec_hash=spec_hash, number=number)
            # Where another plan appeared meanwhile, read the newest again.
            publish(self.storage, f"plans/{number}.json", encode_record(plan))

    def plan(self) -> Plan | None:
        """The newest plan; None where the first one is not written yet."""
        numbers = self.numbers("plans", width=1)
        if not numbers:
            return None
        if self._plan is not None and self._plan.number == max(numbers):  # plans do not change
            return self._plan
        plan = read_record(self.storage, key := f"plans/{max(numbers)}.json", Plan)
        if plan is None:  # removed since the listing
            return self.plan()
        if found := other_value(plan, spec_hash=self.manifest.spec_hash, number=max(numbers)):
            raise InputError(f"{self.storage.url}/{key}", *found, REPAIR)
        self._plan = plan
        return plan

    # Shards and commits.

    def counted(self, n: int) -> ShardRanges:
        """The scenes that count among those of the first n samples."""
        scenes = ShardRanges.of(range(-(-n // self.layout.candidates_per_scene)))
        return scenes if self.scenes is None else scenes.within(self.scenes)

    def planned(self, n: int | None = None) -> ShardRanges:
        """The shards whose rows count among the first n samples [the wanted ones]."""
        return self.counted(self.n if n is None else n).blocks(self.layout.scenes_per_shard)

    def samples_wanted(self, n: int) -> int:
        """Of the first n samples those that count."""
        each = self.layout.candidates_per_scene
        return sum(min(past * each, n) - min(first * each, n) for first, past in self.counted(n).ranges)

    def rows_of(self, shard: int, n: int) -> Rows:
        """The rows of a shard that count among the first n samples; the last shard may be cut."""
        size, each = self.layout.scenes_per_shard, self.layout.candidates_per_scene
        scenes, samples = self.layout.rows_wanted(shard, n)
        if self.scenes is None:
            return Rows(0, scenes, samples)
        start = shard * size
        spans = ShardRanges.of(range(start, start + scenes)).within(self.scenes).ranges
        first, past = (spans[0][0] - start, spans[-1][1] - start) if spans else (0, 0)
        return Rows(first, past - first, min(past * each, samples) - min(first * each, samples))

    def committed(self) -> set[int]:
        return self.numbers("commits")

    def missing(self) -> ShardRanges:
        """Planned shards that are neither committed nor quarantined, in order."""
        decided = self.numbers("commits") | self.numbers("quarantine")
        return self.planned().without(ShardRanges.of(decided))

    def commit_of(self, shard: int) -> Commit:
        """The commit record of a committed shard, checked against the manifest."""
        for commit in self.commits([shard]):
            return commit
        place = f"{self.storage.url}/{commit_key(shard)}"
        raise InputError(place, "", "no such commit", "Make the shard with `datagen resume`")

    def commits(self, shards: Iterable[int] | None = None) -> Iterator[Commit]:
        """The commits that shards [all committed] have, checked against the manifest."""
        shards = sorted(self.committed()) if shards is None else list(shards)
        files = self.storage.get_many(map(commit_key, shards), MAX_RECORD_BYTES)
        for shard, (key, data) in zip(shards, files, strict=True):
            if data is not None:
                place = f"{self.storage.url}/{key}"
                commit = decode_record(place, data, Commit)
                if (found := foreign_field(self.manifest, shard, commit)) is not None:
                    raise InputError(place, *found, "Remove this foreign commit")
                yield commit

    def remember(self, commit: Commit) -> None:
        """Remember a commit that this process has the words of, so that `brief_commits` does not read it."""
        if len(self._remembered) < _MOST_REMEMBERED:
            self._remembered[commit.shard] = _in_brief(commit)

    def brief_commits(self) -> Iterator[Commit]:
        """As `commits`, without cost and machine: most of their memory."""
        shards = self.committed()
        read = self.commits(sorted(shards - self._remembered.keys()))
        known = (self._remembered[shard] for shard in sorted(shards & self._remembered.keys()))
        return merge(map(_in_brief, read), known, key=lambda commit: commit.shard)

    def write_object(self, attempt: str, data: bytes) -> FileEntry:
        """Write an attempt's rows durably, and return the entry for its commit."""
        if len(data) > MAX_FILE_BYTES:
            problem = f"has {len(data):,} bytes, more than 2 GiB"
            fix = "Give fewer --candidates-per-scene, or fewer observation.n_points in --config"
            raise InputError(f"shard of attempt {attempt}", "", problem, fix)
        self.refuse_replaced()
        if not self.storage.put_new(object_key(attempt), data):
            place = f"{self.storage.url}/{object_key(attempt)}"
            raise InputError(place, "", "exists already", "Give every attempt its own name")
        return FileEntry.of(f"{attempt}.zip", data)

    def commit(self, commit: Commit) -> bool:
        """Commit a shard whose object is written. False where another attempt is, and the object is spare."""
        return self.storage.put_new(commit_key(commit.shard), encode_record(commit))

    def read_object(self, commit: Commit, check: bool = True) -> bytes:
        """The committed bytes of a shard's rows; without `check`, not compared with their sha256.

        InputError where they are missing or have another sha256.
        """
        entry = commit.object
        data = self.storage.get(key := f"shards/{entry.path}", entry.size)
        problem = "no such file"
        if data is not None:
            if not check or sha256(data).hexdigest() == entry.sha256:
                return data
            problem = f"has {len(data)} bytes with another sha256 than the commit"
        raise InputError(f"{self.storage.url}/{key}", "", problem, REPAIR)

    def close_lost_attempts(self, ended: str | None = None) -> int:
        """End attempts of killed drivers, as lost with unknown cost, `ended` [now]; return their number.

        Call it when a job has ended. The worker of a killed driver may outlive it and still commit, so only
        attempts whose shard is decided without them are ended. If the driver is still running, its own
        record replaces this one. Attempts of open shards stay open for the job that resumes.
        """
        self.refuse_replaced()
        committed = {commit.attempt: commit.shard for commit in self.brief_commits()}
        decided = set(committed.values()) | self.quarantined()
        lost = [start for start in self.ledger.unfinished(committed) if start.shard in decided]
        for start in lost:
            self.ledger.end(lost_end(start, utc_now() if ended is None else ended))
        return len(lost)

    # Quarantine.

    def quarantine(self, record: QuarantineRecord) -> bool:
        """Quarantine a shard; False where it already was."""
        self.refuse_replaced()
        cut = tuple(stack[-MAX_STACK_CHARS:] for stack in record.stacks)
        kept = record.model_copy(update={"stacks": cut})
        return self.storage.put_new(f"quarantine/{record.shard:06d}.json", encode_record(kept))

    def quarantined(self) -> set[int]:
        """Quarantined shards, by listing. A shard that was committed later counts as committed."""
        found = self.numbers("quarantine")
        return found - self.committed() if found else found

    @property
    def command_for_missing(self) -> str:
        more = " --quarantined" if self.quarantined() else ""
        return f"datagen resume {self.storage.url}{more}"

    def quarantine_records(self) -> list[QuarantineRecord]:
        keys = [f"quarantine/{shard:06d}.json" for shard in sorted(self.quarantined())]
        return list(read_records(self.storage, keys, QuarantineRecord))

    def numbers(self, folder: str, width: int = 6) -> set[int]:
        """Numbers of a folder's records, of `width` digits, by listing."""
        names = (file.key.removeprefix(f"{folder}/") for file in self.storage.list(folder))
        numbered = ((name, int(found[1])) for name in names if (found := _NUMBERED.fullmatch(name)))
        # Only names in the form that is written: no drafts, and not "7.json" for "000007.json".
        return {number for name, number in numbered if name == f"{number:0{width}d}.json"}


_NO_HOST = Host(name="", cpu="", cores=0, memory_bytes=0)
_LEFT_OUT = {"cost": Cost(wall_s=0, cpu_s=0), "host": _NO_HOST, "redraws": {}}


def _in_brief(commit: Commit) -> Commit:
    return commit.model_copy(update=_LEFT_OUT)


def open_runs(path: Storage | Path | str) -> list[Run]:
    """Return the run at `path`, or the parts of merged runs in the order of their rows in the store.

    InputError where there is no run, or one that is damaged or of another format.
    """
    storage = path if isinstance(path, Storage) else open_storage(path, probe=False, create=False)
    merged = read_record(storage, MERGED, Merged)
    if merged is None:
        return [Run.open(storage)]
    refuse_other_format(f"{storage.url}/{MERGED}", merged.format_version)
    runs = [Run.open(storage.below(part.folder), ShardRanges.between(part.scenes)) for part in merged.parts]
    for run, part in zip(runs, merged.parts, strict=True):
        if found := other_value(run.manifest, spec_hash=part.spec_hash):
            raise InputError(f"{run.storage.url}/manifest.json", *found, REPAIR)
    return runs


class LabelCounts(NamedTuple):
    """Planned and committed labels of runs, and the number of missing shards."""

    n: int
    labels: int
    missing: int


def label_counts(runs: Iterable[Run]) -> LabelCounts:
    """Sums over runs. Shards beyond a run's n do not count, and the last one is cut."""
    n = labels = missing = 0
    for run in runs:
        run_n = run.n
        planned = run.planned(run_n)
        done = planned.within(ShardRanges.of(run.committed()))
        n += run.samples_wanted(run_n)
        labels += sum(run.rows_of(shard, run_n).samples for shard in done)
        missing += len(planned) - len(done)
    return LabelCounts(n, labels, missing)


def find_scene(runs: Sequence[Run], scene: int) -> tuple[Run, int]:
    """Return the run with scene `scene` of consecutive runs, and the scene's index in it.

    InputError where there are fewer scenes.
    """
    left = scene
    for run in runs:
        scenes = run.counted(run.n)
        if 0 <= left < len(scenes):
            return run, scenes[left]
        left -= len(scenes)
    last = scene - left - 1
    problem = f"{scene} is not in this run" if len(runs) == 1 else f"{scene} is in none of these runs"
    raise InputError(runs[0].storage.url, "--scene", problem, f"Give one from 0 to {last}")

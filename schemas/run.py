"""A run on disk: manifest, plans, shards, commits, ledger and quarantine (docs/data-format.md).

Readers, resume, seal and audit trust commit records alone: a commit is written last and
create-only, so that of two racing attempts one wins and the other is waste.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from hashlib import sha256
from pathlib import Path

from schemas.errors import InputError
from schemas.fields import RecordSchema, sized_schema
from schemas.ledger import MAX_STACK_CHARS, Ledger
from schemas.record_files import (
    MAX_RECORD_BYTES,
    decode_record,
    different_fields,
    encode_record,
    now,
    read_record,
)
from schemas.run_records import (
    FORMAT_VERSION,
    Commit,
    FileEntry,
    Layout,
    Manifest,
    Merged,
    Plan,
    QuarantineRecord,
)
from schemas.shard_ranges import ShardRanges
from schemas.storage import Storage, open_storage
from schemas.storage.errors import OddFile, StoreFailure

_NUMBERED = re.compile(r"([0-9]{1,18})\.json")
# The mark in the folder of an attempt that is being removed.
REMOVING = "removing"
# A commit with its file entries takes some 30 kB of memory.
_COMMITS_KEPT = 1000


class Run:
    """One run. Cheap to open and to send to another process; holds no lock.

    Make it with `Run.create_or_open` or `Run.open`.
    """

    def __init__(self, storage: Storage, manifest: Manifest) -> None:
        self.storage = storage
        self.manifest = manifest
        self.ledger = Ledger(storage)
        self._commits: dict[int, Commit] = {}  # those read last; immutable once written

    def __repr__(self) -> str:
        return f"Run({self.storage.url!r})"

    @classmethod
    def create_or_open(cls, storage: Storage, manifest: Manifest, n: int) -> Run:
        """A new run of n samples, or the one that is there, grown to n if it is shorter.

        An existing run keeps its layout. InputError when it has another specification or format,
        naming every field that differs, or when the place holds files of something else.
        """
        if not storage.exists("manifest.json"):
            refuse_foreign(storage)
            publish(storage, "manifest.json", encode_record(manifest))
        run = cls.open(storage)
        run._refuse_other(manifest)
        run.grow(n)
        return run

    @classmethod
    def open(cls, place: Storage | Path | str) -> Run:
        """An existing run. InputError when there is none, or it is damaged or of another format."""
        storage = place if isinstance(place, Storage) else open_storage(place, probe=False, create=False)
        manifest = read_record(storage, "manifest.json", Manifest)
        if manifest is None:
            merged = read_record(storage, "merged.json", Merged)
            if merged is not None:
                parts = ", ".join(f"{storage.url}/parts/{part[:16]}" for part in merged.parts[:3])
                more = f" or another of {len(merged.parts)}" if len(merged.parts) > 3 else ""
                problem = f"holds {len(merged.parts)} merged runs, and one is needed here"
                raise InputError(storage.url, "", problem, f"Name one of its parts: {parts}{more}")
            raise InputError(storage.url, "manifest.json", "not a run: no such file", "Name a run's folder")
        where = f"{storage.url}/manifest.json"
        if manifest.format_version != FORMAT_VERSION:
            raise InputError(
                where,
                "format_version",
                f"{manifest.format_version}, and this program reads {FORMAT_VERSION}",
                "Use the version of the program that made the run",
            )
        if manifest.spec.hash() != manifest.spec_hash:
            raise InputError(
                where,
                "spec_hash",
                "not the hash of the specification beside it",
                "The manifest was edited: restore it from a copy",
            )
        return cls(storage, manifest)

    @property
    def layout(self) -> Layout:
        """How scenes are cut into shards."""
        return self.manifest.layout

    @property
    def schema(self) -> RecordSchema:
        """The record schema of this run's version, with its axis lengths.

        A run keeps the version it was begun with. InputError for one that this program does not know.
        """
        manifest = self.manifest
        try:
            return sized_schema(manifest.schema_name, manifest.spec, manifest.schema_version)
        except InputError as e:
            raise InputError(f"{self.storage.url}/manifest.json", e.field, e.problem, e.mend) from e

    # Plans: how far to go.

    @property
    def n(self) -> int:
        """Samples wanted by the newest plan."""
        return self._newest_plan()[1]

    def grow(self, n: int, created: str | None = None) -> None:
        """Want at least n samples; a run never shrinks. `created` is when that was said, now by default."""
        if not 1 <= n <= 10**12:
            raise InputError("--n", "", f"{n} samples", "Ask for 1 to 10^12 samples")
        while True:
            number, wanted = self._newest_plan()
            if wanted >= n:
                return
            plan = Plan(n=n, created=created or now())
            # Losing this race means that another plan appeared: look again.
            publish(self.storage, f"plans/{number + 1}.json", encode_record(plan))

    def plan(self) -> Plan | None:
        """The newest plan; None where a run was made and its first plan not yet."""
        number, _ = self._newest_plan()
        return read_record(self.storage, f"plans/{number}.json", Plan) if number else None

    def _newest_plan(self) -> tuple[int, int]:
        numbers = self._numbers("plans", width=1)
        if not numbers:
            return 0, 0
        key = f"plans/{max(numbers)}.json"
        plan = read_record(self.storage, key, Plan)
        return (max(numbers), plan.n) if plan else self._newest_plan()

    # Shards and commits.

    def planned(self) -> range:
        """Indices of the shards that hold the wanted samples."""
        return range(self.layout.shards_for(self.n))

    def committed(self) -> set[int]:
        """Indices of committed shards, by listing."""
        return self._numbers("commits")

    def commit_stamps(self) -> dict[str, str]:
        """Change stamps of all commit records by their names (the shard in six digits), by listing."""
        return dict(self._numbered("commits"))

    def missing(self) -> ShardRanges:
        """Planned shards that are neither committed nor in quarantine, in order."""
        decided = (int(name) for folder in ("commits", "quarantine") for name, _ in self._numbered(folder))
        return ShardRanges.of(self.planned()).without(ShardRanges.of(decided))

    def commit_of(self, shard: int) -> Commit:
        """The commit record of a committed shard, checked against the manifest."""
        if shard not in self._commits:
            key = commit_key(shard)
            data = self.storage.get(key, MAX_RECORD_BYTES)
            if data is None:
                place = f"{self.storage.url}/{key}"
                raise InputError(place, "", "no such commit", "Make it with `datagen resume`")
            while len(self._commits) >= _COMMITS_KEPT:
                del self._commits[next(iter(self._commits))]
            self._commits[shard] = self.decode_commit(shard, data)
        return self._commits[shard]

    def decode_commit(self, shard: int, data: bytes) -> Commit:
        """The commit record in the bytes of a shard's file, checked against the manifest."""
        place = f"{self.storage.url}/{commit_key(shard)}"
        commit = decode_record(place, data, Commit)
        expected = {
            "shard": shard,
            "spec_hash": self.manifest.spec_hash,
            "scenes": self.layout.scenes_per_shard,
            "samples": self.layout.samples_per_shard,
        }
        for field, value in expected.items():
            if (given := getattr(commit, field)) != value:
                raise InputError(
                    place, field, f"{given}, where this run has {value}", "Remove this foreign commit"
                )
        return commit

    def commits(self) -> Iterator[Commit]:
        """Commit records of all committed shards, in order of their shards."""
        shards = sorted(self.committed())
        for shard, (_, data) in zip(
            shards, self.storage.get_many(map(commit_key, shards), MAX_RECORD_BYTES), strict=True
        ):
            if data is not None:  # else it was withdrawn since the listing
                yield self.decode_commit(shard, data)

    def write_shard(self, shard: int, attempt: str, files: Mapping[str, bytes]) -> tuple[FileEntry, ...]:
        """Write an attempt's files durably; its entries for the commit. Nothing counts before it.

        Where the disk refuses one, none is left behind: a full disk gets its room back.
        """
        folder = shard_folder(shard, attempt)
        entries = tuple(
            FileEntry(path=path, size=len(data), sha256=sha256(data).hexdigest())
            for path, data in files.items()
        )
        try:
            self.storage.put_many({f"{folder}/{path}": data for path, data in files.items()})
            self.storage.sync(f"{folder}/{path}" for path in files)
        except StoreFailure:
            raise  # it would not delete either
        except InputError:
            with suppress(InputError):
                self.storage.delete(f"{folder}/{path}" for path in files)
            raise
        return entries

    def commit(self, commit: Commit) -> bool:
        """Publish a shard. False when another attempt has won; its files then are garbage.

        The attempt's folder keeps a copy of the record, from which a damaged one is restored. The commit
        of an attempt whose files are removed as garbage meanwhile is taken back (schemas/garbage.py).
        """
        if (problem := self._lack(commit, committing=True)) is not None:
            raise problem
        record = encode_record(commit)
        copy = commit_copy_key(commit.shard, commit.attempt)
        self.storage.put(copy, record)
        self.storage.sync([copy])
        won = self.storage.put_new(commit_key(commit.shard), record)
        if not won:
            self.storage.delete([copy])
        elif (problem := self._lack(commit, committing=True)) is not None:
            self.storage.delete([commit_key(commit.shard)])
            raise problem
        return won

    def check_files(self, commit: Commit) -> None:
        """Refuse a commit whose files are absent or of another size (bytes are not read)."""
        if (problem := self._lack(commit)) is not None:
            raise problem

    def _lack(self, commit: Commit, committing: bool = False) -> InputError | None:
        folder = shard_folder(commit.shard, commit.attempt)
        sizes = {f.key: f.size for f in self.storage.list(folder)}
        if committing and (mark := f"{folder}/{REMOVING}") in sizes:
            place, problem = f"{self.storage.url}/{mark}", "the attempt is being removed as garbage"
            return InputError(place, "", problem, "Make it again with `datagen resume`")
        for entry in commit.files:
            size = sizes.get(f"{folder}/{entry.path}")
            if size != entry.size:
                return InputError(
                    f"{self.storage.url}/{folder}/{entry.path}",
                    "",
                    "missing" if size is None else f"{size} bytes, where the commit has {entry.size}",
                    "Restore the file from a copy, or mend the run with `datagen repair`",
                )
        return None

    def check_digests(self, commit: Commit) -> None:
        """Refuse a commit one of whose files has other bytes than were committed."""
        self.check_files(commit)
        folder = shard_folder(commit.shard, commit.attempt)
        keys = (f"{folder}/{entry.path}" for entry in commit.files)
        largest = max((entry.size for entry in commit.files), default=0)
        for entry, (key, data) in zip(commit.files, self.storage.get_many(keys, largest), strict=True):
            if data is None or sha256(data).hexdigest() != entry.sha256:
                raise InputError(
                    f"{self.storage.url}/{key}",
                    "sha256",
                    "the file is damaged",
                    "Restore the file from a copy, or mend the run with `datagen repair`",
                )

    # Quarantine.

    def quarantine(self, record: QuarantineRecord) -> bool:
        """Give a shard up; False when it was before."""
        cut = tuple(stack[-MAX_STACK_CHARS:] for stack in record.stacks)
        kept = record.model_copy(update={"stacks": cut})
        return self.storage.put_new(f"quarantine/{record.shard:06d}.json", encode_record(kept))

    def quarantined(self) -> set[int]:
        """Shards that were given up, by listing. One that was committed later counts as committed."""
        return self._numbers("quarantine") - self.committed()

    def quarantine_records(self) -> list[QuarantineRecord]:
        """Records of the shards in quarantine, in order."""
        keys = [f"quarantine/{shard:06d}.json" for shard in sorted(self.quarantined())]
        found = (read_record(self.storage, key, QuarantineRecord) for key in keys)
        return [record for record in found if record is not None]

    def _numbers(self, folder: str, width: int = 6) -> set[int]:
        return {int(name) for name, _ in self._numbered(folder, width)}

    def _numbered(self, folder: str, width: int = 6) -> Iterator[tuple[str, str]]:
        """(name, change stamp) of a folder's records that have a number for a name."""
        for file in self.storage.list(folder):
            name = file.key.removeprefix(f"{folder}/")
            # Only names that this program gives: not drafts, and not "7.json" for "000007.json".
            if (found := _NUMBERED.fullmatch(name)) and name == f"{int(found.group(1)):0{width}d}.json":
                yield found.group(1), file.stamp

    def _refuse_other(self, manifest: Manifest) -> None:
        _ = self.schema  # refuses a version that this program does not know
        ours = manifest.model_dump(mode="json")
        theirs = self.manifest.model_dump(mode="json")
        keys = ("spec", "schema_name")  # not its version: a run goes on in the one it was begun with
        rows = different_fields({k: ours[k] for k in keys}, {k: theirs[k] for k in keys})
        if self.layout.candidates_per_scene != manifest.layout.candidates_per_scene:
            raise InputError(
                f"{self.storage.url}/manifest.json",
                "layout.candidates_per_scene",
                f"{self.layout.candidates_per_scene}, not the {manifest.layout.candidates_per_scene} asked",
                "Choose another --out",
            )
        if rows:
            shown = [f"{path.removeprefix('spec.')}: it has {b!r}, asked {a!r}" for path, a, b in rows[:20]]
            more = f"; and {len(rows) - 20} more" if len(rows) > 20 else ""
            raise InputError(
                f"{self.storage.url}/manifest.json",
                "",
                "another specification lives here (" + "; ".join(shown) + more + ")",
                "Choose another --out, or ask for what it has",
            )


def shard_folder(shard: int, attempt: str) -> str:
    """Key of the folder of one attempt at a shard."""
    return f"shards/{shard:06d}/{attempt}"


def commit_key(shard: int) -> str:
    """Key of a shard's commit record."""
    return f"commits/{shard:06d}.json"


def commit_copy_key(shard: int, attempt: str) -> str:
    """Key of the copy of a commit record in its attempt's folder."""
    return f"{shard_folder(shard, attempt)}/commit.json"


def copy_key(key: str) -> str:
    """Key of the copy of a record at the run's root."""
    return f"copies/{key}"


def publish(storage: Storage, key: str, record: bytes) -> None:
    """Write a record of the run's root once: its copy first, then the record with the copy's bytes.

    The copy decides races, so that both are always equal; one that was killed in between is completed
    by the next.
    """
    storage.put_new(copy_key(key), record)
    kept = storage.get(copy_key(key), MAX_RECORD_BYTES)
    storage.put_new(key, record if kept is None else kept)


def refuse_foreign(storage: Storage, *also: str) -> None:
    """Refuse a place without a run that holds files of something else; `also` begin further names of ours."""
    ours = ("manifest.json", "plans/", "copies/", "shards/", "commits/", "ledger/", ".probe-", *also)
    problem, mend = "the folder holds files of something else", "Choose a new --out"
    try:
        for file in storage.list(""):
            if not file.key.startswith(ours):
                raise InputError(storage.url, file.key, problem, mend)
    except OddFile as e:
        raise InputError(e.place, "", problem, mend) from e

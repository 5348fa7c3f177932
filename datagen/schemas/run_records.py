"""The JSON records of a run: manifest, plan, commit, ledger entries, quarantine; shards and costs in them.

Records are validated when read from disk.
"""

from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from hashlib import sha256
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
)

from datagen.schemas.specification import Specification

FORMAT_VERSION = 3
Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
# A file name without folders, and a path of such names: neither can lead outside the run.
AttemptName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,99}$")]
FilePath = Annotated[
    str, Field(max_length=300, pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*(/[A-Za-z0-9_][A-Za-z0-9_.-]*)*$")
]
Outcome = Literal[
    "committed", "superseded", "failed", "crashed", "hung", "out_of_memory", "lost", "cancelled"
]


class StoredRecord(BaseModel):
    """Base of records on disk: immutable, and without unknown fields."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Layout(StoredRecord):
    """Division of scenes into shards. Fixed for a run; no sample depends on it."""

    scenes_per_shard: int = Field(ge=1, le=100_000)
    candidates_per_scene: int = Field(ge=1, le=1_000_000)

    def __hash__(self) -> int:
        return hash((self.scenes_per_shard, self.candidates_per_scene))

    @property
    def samples_per_shard(self) -> int:
        return self.scenes_per_shard * self.candidates_per_scene

    def shards_for(self, n: int) -> int:
        """Shards that hold the first n samples."""
        return -(-n // self.samples_per_shard)

    def rows_wanted(self, shard: int, n: int) -> tuple[int, int]:
        """(scenes, samples) of a shard among the first n samples; the last shard may be cut."""
        samples = min(max(n - shard * self.samples_per_shard, 0), self.samples_per_shard)
        return -(-samples // self.candidates_per_scene), samples


class Manifest(StoredRecord):
    """manifest.json: specification, layout and origin of a run. Written once, create-only."""

    format_version: int = FORMAT_VERSION
    spec: Specification
    spec_hash: Digest
    schema_name: str
    schema_version: int
    layout: Layout
    code_version: str
    code_digest: Digest  # of the package's Python files, on the machine that began the run
    libraries: dict[str, str]
    platform: str
    created: str
    # Addresses and numbers of houses and objects; not part of the run's identity.
    sources: dict[str, str] = Field(default_factory=dict)

    @property
    def made_from(self) -> str:
        """Houses, objects, robot and chosen places: "400 builtin houses (split all), 58 builtin objects"."""
        spec, known = self.spec, self.sources
        houses = f"{known.get('n_houses', '')} {spec.houses.kind} houses (split {spec.split})"
        objects = f"{known.get('n_objects', '')} {spec.objects.kind} objects"
        robot = f"robot {spec.arm.robot}" if spec.arm else "sampled robots"
        if spec.scene.places is not None:
            kinds = (kind for kind, weight in spec.scene.places.weights().items() if weight)
            robot += f", places {'/'.join(kinds)}"
        return ", ".join(part.strip() for part in (houses, objects, robot))


class Plan(StoredRecord):
    """plans/<k>.json: the number of samples wanted. The newest counts; a run only grows."""

    n: int = Field(ge=1, le=10**12)
    created: str
    spec_hash: Digest
    number: int = Field(ge=1)


_Number = Annotated[int, Field(ge=0, le=10**18)]
OPEN_END = 10**18  # of the scenes of a part that a resume extends


def _ascending(ranges: tuple[tuple[int, int], ...]) -> tuple[tuple[int, int], ...]:
    numbers = [number for each in ranges for number in each]
    if numbers != sorted(numbers) or any(first == past for first, past in ranges):
        raise ValueError("the ranges are not ascending")
    return ranges


# First and one past the last of each range.
Ranges = Annotated[tuple[tuple[_Number, _Number], ...], AfterValidator(_ascending)]


class MergedPart(StoredRecord):
    """One of merged runs: the folder that holds it, and its scenes that count."""

    folder: FilePath
    spec_hash: Digest
    scenes: Ranges


class Merged(StoredRecord):
    """merged.json: merged runs, in the order of their rows. No scene counts in two of them."""

    format_version: int = FORMAT_VERSION
    parts: tuple[MergedPart, ...] = Field(min_length=2)


MAX_FILE_BYTES = 2**31  # of an object, or of a file of a sealed store; one is read as a whole


class FileEntry(StoredRecord):
    """One file: its path below the folder that its record describes, its size and its digest."""

    path: FilePath
    size: int = Field(ge=0, le=MAX_FILE_BYTES)
    sha256: Digest

    @classmethod
    def of(cls, path: str, data: bytes) -> FileEntry:
        return cls(path=path, size=len(data), sha256=sha256(data).hexdigest())


class Cost(StoredRecord):
    """Cost of one attempt. `stage_gpu_s` is never measured; stored records have the field.

    `source_s` is in no other number: wall and CPU seconds of the relabelled attempt, where this attempt only
    applied another rule.
    """

    wall_s: float = Field(ge=0)
    cpu_s: float = Field(ge=0)
    stage_wall_s: dict[str, float] = Field(default_factory=dict)
    stage_cpu_s: dict[str, float] = Field(default_factory=dict)
    stage_gpu_s: dict[str, float] = Field(default_factory=dict)
    peak_rss_bytes: int = 0
    written_bytes: int = 0
    source_s: dict[Literal["wall", "cpu"], Annotated[float, Field(ge=0, allow_inf_nan=False)]] = Field(
        default_factory=dict
    )

    @model_serializer(mode="wrap")
    def _without_empty_source(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {name: value for name, value in plain(self).items() if name != "source_s" or value}

    @property
    def all_s(self) -> dict[Literal["wall", "cpu"], float]:
        """Seconds by clock of the attempt, and of the one that it relabelled."""
        before = self.source_s
        return {"wall": self.wall_s + before.get("wall", 0.0), "cpu": self.cpu_s + before.get("cpu", 0.0)}


class Host(StoredRecord):
    """Fingerprint of the machine that ran an attempt."""

    name: str
    cpu: str
    cores: int
    memory_bytes: int
    gpu: str = ""  # in stored records; never filled
    pid: int = 0


class Commit(StoredRecord):
    """commits/<shard>.json: written last and create-only; readers trust nothing else."""

    format_version: int = FORMAT_VERSION
    shard: int = Field(ge=0, le=10**12)
    attempt: AttemptName
    spec_hash: Digest
    scenes: int = Field(ge=0)
    samples: int = Field(ge=0)
    positives: int = Field(ge=0)
    redraws: dict[str, int]
    object: FileEntry  # the rows, in shards/
    cost: Cost
    host: Host
    code_digest: Digest  # of the package's Python files that made the shard
    created: str


def foreign_field(manifest: Manifest, shard: int, commit: Commit) -> tuple[str, str] | None:
    """(field, problem) where a commit cannot belong to this shard of the run; else None."""
    layout = manifest.layout
    expected = {"shard": shard, "spec_hash": manifest.spec_hash, "scenes": layout.scenes_per_shard}
    found = other_value(commit, **expected, samples=layout.samples_per_shard)
    return found or other_value(commit.object, path=f"{commit.attempt}.zip")


def other_value(record: StoredRecord, **expected: object) -> tuple[str, str] | None:
    """(field, problem) of the first field with another value; None where there is none."""
    for name, value in expected.items():
        if (given := getattr(record, name)) not in (None, value):
            return name, f"is {given}, but {value} in this run"
    return None


class AttemptStart(StoredRecord):
    """ledger/<attempt>.start.json: an attempt that began; without an end it was lost."""

    format_version: int = FORMAT_VERSION
    attempt: AttemptName
    shard: int = Field(ge=0)
    started: str
    host: str = ""
    # Random for each start: a create-only put that finds its own bytes counts as its own.
    writer: str = ""


class LedgerEntry(StoredRecord):
    """ledger/<attempt>.json: outcome and cost of an attempt without a commit, which has them of others."""

    format_version: int = FORMAT_VERSION
    attempt: AttemptName
    shard: int = Field(ge=0)
    outcome: Outcome
    cause: str = ""
    stack: str = ""
    started: str = ""
    ended: str = ""
    cost: Cost | None = None  # None where unknown
    host: Host | None = None


class QuarantineRecord(StoredRecord):
    """quarantine/<shard>.json: a quarantined shard, with all that is needed to run it alone."""

    format_version: int = FORMAT_VERSION
    shard: int = Field(ge=0)
    seed: int
    first_scene: int
    scenes: int
    attempts: tuple[str, ...]
    causes: tuple[str, ...]
    stacks: tuple[str, ...]
    created: str


class SealedPart(StoredRecord):
    """One run in a sealed store: the samples wanted of it, and its missing shards."""

    spec_hash: Digest
    scenes_per_shard: int
    n: int = Field(ge=1, le=10**12)
    samples: int = Field(ge=0)
    missing: Ranges


class StoreRecord(StoredRecord):
    """data.json: the sealed store that counts, what it was made from, and its files.

    `rows_sha256` is over the digests of its shards, in order.
    """

    format_version: int = FORMAT_VERSION
    name: str = Field(pattern=r"^data(-[1-9][0-9]{0,8})?\.zarr$")
    rows_sha256: Digest
    parts: tuple[SealedPart, ...] = Field(min_length=1)
    files: tuple[FileEntry, ...]

    def part_of(self, manifest: Manifest) -> SealedPart | None:
        """What it holds of the run with this manifest."""
        key = manifest.spec_hash, manifest.layout.scenes_per_shard
        return next((part for part in self.parts if (part.spec_hash, part.scenes_per_shard) == key), None)


STAGES = ("draw", "settle", "observe", "visibility", "grasps", "plan", "execute", "write")


@dataclass
class StageClock:
    """Adds up wall and CPU seconds by stage.

    CPU seconds are those of the whole process, so that threads of libraries count. The time of a nested stage
    is subtracted from the outer one, so that every second counts once.
    """

    wall_s: dict[str, float] = field(default_factory=dict)
    cpu_s: dict[str, float] = field(default_factory=dict)
    _inner: list[tuple[float, float]] = field(default_factory=list)  # (wall, CPU) spent within open stages

    @contextmanager
    def stage(self, name: str) -> Generator[None]:
        if name not in STAGES:
            raise KeyError(f"unknown stage {name!r}; stages are {', '.join(STAGES)}")
        wall, cpu = time.perf_counter(), time.process_time()
        self._inner.append((0.0, 0.0))
        try:
            yield
        finally:
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            inner_wall, inner_cpu = self._inner.pop()
            self.wall_s[name] = self.wall_s.get(name, 0.0) + wall - inner_wall
            self.cpu_s[name] = self.cpu_s.get(name, 0.0) + cpu - inner_cpu
            if self._inner:
                outer_wall, outer_cpu = self._inner[-1]
                self._inner[-1] = (outer_wall + wall, outer_cpu + cpu)

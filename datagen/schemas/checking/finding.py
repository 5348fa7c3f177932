"""A finding of a check: the file, the problem and the fix."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

from datagen.schemas.run import Run
from datagen.schemas.run_records import FileEntry

# record: a JSON record is damaged, missing, or differs from its copy. account: the ledger is inconsistent.
# file: a committed file is missing or has other bytes. rows: committed rows break the schema. lost: a
# commit and its copy are missing. foreign: a file that no record names. sealed: data.zarr differs from
# its shards. deep: recomputed rows differ. stale: data.zarr is older than its run.
Kind = Literal["record", "account", "file", "rows", "lost", "foreign", "sealed", "deep", "stale"]

REPAIR = "Run datagen repair"


@dataclass(frozen=True)
class Restore:
    """Write these bytes, which come from a second copy or follow from other records.

    `is_guess` where a running process may still write the true record: then only a missing file is written.
    """

    data: bytes
    is_guess: bool = False


@dataclass(frozen=True)
class Regenerate:
    """Compute the shard again; its file must have the committed size and digest."""

    run: Run
    shard: int
    entry: FileEntry


@dataclass(frozen=True)
class Reseal:
    """Seal again; or, where that cannot be done in one step, repair this file of the store.

    The file is a copy of `source`, or has these bytes, or must not exist.
    """

    source: str = ""
    data: bytes | None = None


Cure = Restore | Regenerate | Reseal


@dataclass(frozen=True)
class Finding:
    """One problem. `key` is the file or folder, relative to the checked path."""

    key: str
    kind: Kind
    problem: str
    fix: str
    shard: int | None = None
    cure: Cure | None = None

    @property
    def is_damage(self) -> bool:
        """Whether data is damaged; an outdated sealed store is not damage."""
        return self.kind != "stale"


def below(prefix: str, findings: Iterable[Finding]) -> Iterator[Finding]:
    """The findings with keys relative to the merged runs, which hold their run in the folder `prefix`."""
    return (replace(finding, key=prefix + finding.key) for finding in findings)


def curable(key: str, kind: Kind, problem: str, cure: Cure, shard: int | None = None) -> Finding:
    """A finding that `datagen repair` fixes."""
    return Finding(key, kind, problem, REPAIR, shard, cure)

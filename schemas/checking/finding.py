"""What a check found: where, what is wrong, and what would mend it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from datagen.schemas.run import Run
from datagen.schemas.run_records import FileEntry

# record: a JSON record is damaged, missing, or unlike its copy. account: the ledger does not add up.
# file: a committed file is missing or has other bytes. rows: what was committed breaks the schema.
# lost: a commit is gone, and its copy too. foreign: a file that no record knows. sealed: data.zarr is
# not what its shards are. deep: recomputed rows are others. stale: data.zarr is older than its run.
Kind = Literal["record", "account", "file", "rows", "lost", "foreign", "sealed", "deep", "stale"]

REPAIR = "Run datagen repair"


@dataclass(frozen=True)
class Restore:
    """Put these bytes: they come from a second copy, or follow from other records.

    `is_guess` where whoever is still at work may write the truth: then only a missing file is made.
    """

    data: bytes
    is_guess: bool = False


@dataclass(frozen=True)
class Regenerate:
    """Compute the shard of this run again; its file must have the committed size and digest."""

    run: Run
    shard: int
    entry: FileEntry


@dataclass(frozen=True)
class Reseal:
    """Seal the place anew; or, where that cannot be done at once, mend this file of the store.

    It is a copy of the file `source` below the place, or has these bytes, or must not be there.
    """

    source: str = ""
    data: bytes | None = None


Cure = Restore | Regenerate | Reseal


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong. `key` is the file or folder below the place that was checked."""

    key: str
    kind: Kind
    problem: str
    mend: str
    shard: int | None = None
    cure: Cure | None = None

    @property
    def is_damage(self) -> bool:
        """Whether something is wrong; an old sealed store is only behind."""
        return self.kind != "stale"


def curable(key: str, kind: Kind, problem: str, cure: Cure, shard: int | None = None) -> Finding:
    """A finding that `datagen repair` mends."""
    return Finding(key, kind, problem, REPAIR, shard, cure)

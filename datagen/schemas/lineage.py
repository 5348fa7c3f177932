"""The origins of the shards of a merged run: `lineage.json` names the runs that made them.

Origins are resolved: for a source that was itself merged, the runs that it names are recorded.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Mapping
from itertools import groupby
from typing import Annotated, Any, NamedTuple

from pydantic import Field

from datagen.schemas.record_files import encode_record, read_record
from datagen.schemas.run import Run
from datagen.schemas.run_records import FORMAT_VERSION, StoredRecord

LINEAGE = "lineage.json"
_Shard = Annotated[int, Field(ge=0, le=10**18)]


class ShardOrigin(NamedTuple):
    """A run that made shards: its address when it was merged, and its manifest. Sorted in this order."""

    address: str
    created: str
    platform: str
    code_version: str


class LineageSource(StoredRecord):
    """One origin and its shards, as ranges of first and last."""

    address: str
    created: str
    platform: str
    code_version: str
    shards: tuple[tuple[_Shard, _Shard], ...]


class Lineage(StoredRecord):
    """lineage.json: the origins of a run that was merged, in order of their addresses."""

    format_version: int = FORMAT_VERSION
    sources: tuple[LineageSource, ...]


class Origins:
    """The origins of one run's shards."""

    def __init__(self, run: Run) -> None:
        manifest = run.manifest
        self.own = ShardOrigin(
            address=run.storage.url,
            platform=manifest.platform,
            code_version=manifest.code_version,
            created=manifest.created,
        )
        lineage = read_record(run.storage, LINEAGE, Lineage)
        sources = lineage.sources if lineage else ()
        self.named = tuple(ShardOrigin(**source.model_dump(exclude={"shards"})) for source in sources)
        ranges = [
            (first, last, origin)
            for source, origin in zip(sources, self.named, strict=True)
            for first, last in source.shards
        ]
        self._ranges = sorted(ranges, key=lambda r: r[:2])
        self._firsts = [first for first, _, _ in self._ranges]

    @property
    def is_merged(self) -> bool:
        return bool(self.named)

    def of(self, shard: int) -> ShardOrigin:
        """The origin of a shard; the run itself where the lineage names none."""
        k = bisect_right(self._firsts, shard) - 1
        if k >= 0 and shard <= self._ranges[k][1]:
            return self._ranges[k][2]
        return self.own


def encode_lineage(shards: Mapping[ShardOrigin, Iterable[int]]) -> bytes:
    """The bytes of the record from the shards of each origin."""
    sources = [LineageSource(**origin._asdict(), shards=_ranges(shards[origin])) for origin in sorted(shards)]
    return encode_record(Lineage(sources=tuple(sources)))


def lineage_summary(run: Run) -> list[dict[str, Any]]:
    """The origins of a run's committed shards with counts and ranges; empty where it was not merged."""
    origins = Origins(run)
    if not origins.is_merged:
        return []
    found: dict[ShardOrigin, list[int]] = {origin: [] for origin in origins.named}
    for shard in sorted(run.committed()):
        found.setdefault(origins.of(shard), []).append(shard)
    return [
        {**origin._asdict(), "shards": len(shards), "ranges": [list(r) for r in _ranges(shards)]}
        for origin, shards in sorted(found.items())
    ]


def _ranges(shards: Iterable[int]) -> tuple[tuple[int, int], ...]:
    runs = groupby(enumerate(sorted(shards)), key=lambda pair: pair[1] - pair[0])
    grouped = ([shard for _, shard in group] for _, group in runs)
    return tuple((group[0], group[-1]) for group in grouped)

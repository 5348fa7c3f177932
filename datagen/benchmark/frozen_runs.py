"""Compare a run's folder with the definition: specification, size, candidates and labels."""

from __future__ import annotations

import hashlib
from pathlib import Path

from datagen.benchmark.definition import BenchmarkRun, RunDigests
from datagen.schemas.errors import InputError
from datagen.schemas.record_files import different_fields
from datagen.train.reader import SampleReader
from datagen.train.run_parts import open_parts

_FIELDS = ("sample_id", "label")
_MOST_SHOWN = 5


def digests_of(path: str | Path) -> RunDigests:
    """The digests of a complete run or of its sealed store; copies have the same digests."""
    candidates, labels = hashlib.sha256(), hashlib.sha256()
    for columns in SampleReader([path], (), _FIELDS).shards():
        candidates.update(columns["sample_id"].tobytes())
        labels.update(columns["label"].astype("u1").tobytes())
    return RunDigests(candidates=candidates.hexdigest(), labels=labels.hexdigest())


def refuse_differing(path: str, name: str, wanted: BenchmarkRun, version: str) -> None:
    """Raise InputError with the differences from the benchmark's run.

    Digests are compared if the definition has them.
    """
    definition = f"run {name} of benchmark {version}"
    fix = f"Make it with `datagen benchmark make --run {name}`, or copy the run"
    parts = open_parts([path], _FIELDS)
    for part in parts:
        ours, theirs = (s.model_dump(mode="json") for s in (wanted.spec, part.specs[0]))
        if rows := different_fields(ours, theirs):
            shown = [f"{field} is {b!r}, but {a!r} in {definition}" for field, a, b in rows[:_MOST_SHOWN]]
            more = f"; and {len(rows) - _MOST_SHOWN} more" if len(rows) > _MOST_SHOWN else ""
            raise InputError(path, "specification", "; ".join(shown) + more, fix)
    samples = sum(shard.samples for part in parts for shard in part.shards)
    if samples != wanted.n:
        raise InputError(path, "labels", f"are {samples:,}, but {wanted.n:,} in {definition}", fix)
    if wanted.digests is None:
        return
    found = digests_of(path)
    differing = [
        f"{column} have the digest {ours[:12]}, but {theirs[:12]} in {definition}"
        for column, ours, theirs in (
            ("candidates", found.candidates, wanted.digests.candidates),
            ("labels", found.labels, wanted.digests.labels),
        )
        if ours != theirs
    ]
    if differing:
        raise InputError(path, "", "; ".join(differing), fix)

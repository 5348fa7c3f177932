"""Runs whose every digest is right and whose rows are not: what only a recomputation finds."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from datagen.schemas.record_files import commit_key, encode_record
from datagen.schemas.run import Run
from datagen.schemas.shard_files import encode_shard
from datagen.schemas.shard_reading import read_shard

Columns = dict[str, np.ndarray[Any, Any]]


def forge(source: Path, out: Path, shard: int, change: Callable[[Columns], None]) -> Run:
    """A copy of a run in which `change` has altered the arrays of one shard, with a commit that says so."""
    shutil.copytree(source, out)
    run = Run.open(out)
    arrays = arrays_of_shard(run, shard)
    change(arrays)
    scenes = {f.name: arrays[f.name] for f in run.schema.scene_fields}
    samples = {f.name: arrays[f.name] for f in run.schema.sample_fields}
    data = encode_shard(run.schema, run.layout, run.manifest.spec_hash, scenes, samples)
    commit = run.commit_of(shard)
    entry = run.write_object("forged", data)
    forged = encode_record(commit.model_copy(update={"attempt": "forged", "object": entry}))
    run.storage.put(commit_key(shard), forged)
    return Run.open(out)


def arrays_of_shard(run: Run, shard: int) -> Columns:
    """All arrays of a committed shard, writable."""
    return {name: values.copy() for name, values in read_shard(run, shard).items()}

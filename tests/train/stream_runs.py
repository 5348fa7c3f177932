"""Runs of random rows that training can read: robots share their numbers, houses and clouds make sense."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from datagen.schemas.run import Run
from datagen.schemas.run_records import Layout
from datagen.schemas.shard_files import chunk_path, encode_chunk, encode_shard
from datagen.schemas.storage import open_storage
from tests.made_runs import Tables, commit_of, manifest_of, rows_of, small_spec, with_files

ROBOT_FIELDS = ("camera_height_m", "base_height_m", "arm_reach_m")
HOUSES = 7


def make_stream_run(
    folder: Path | str,
    n: int,
    *,
    scenes_per_shard: int = 3,
    candidates_per_scene: int = 6,
    robots: int = 2,
    seed: int = 0,
    cloud_points: int = 64,
    **changes: Any,
) -> Run:
    """A run of n samples. `changes` are columns stored as one value throughout, also against the schema."""
    layout = Layout(scenes_per_shard=scenes_per_shard, candidates_per_scene=candidates_per_scene)
    manifest = manifest_of(small_spec(seed, cloud_points), layout)
    run = Run.create_or_open(open_storage(folder), manifest, n)
    for shard in run.missing():
        scenes, samples = stream_rows(run, shard, robots)
        data = encode_shard(run.schema, layout, manifest.spec_hash, scenes, samples)
        changed: dict[str, bytes] = {}
        for field in (*run.schema.scene_fields, *run.schema.sample_fields):
            if field.name in changes:
                values = np.full_like((scenes | samples)[field.name], changes[field.name])
                changed[chunk_path(field.name, 0, len(field.dims))] = encode_chunk(field, values)
        entry = run.write_object(f"a-{shard}", with_files(data, changed))
        assert run.commit(commit_of(run, shard, f"a-{shard}", entry, int(samples["label"].sum())))
    return run


def stream_rows(run: Run, shard: int, robots: int = 2) -> Tables:
    """The rows of a shard: robots of a scene take turns, and houses take turns among the scenes."""
    scenes, samples = rows_of(run, shard)
    samples["robot_index"][:] = samples["candidate_index"] % robots
    first = len(samples["robot_index"]) // len(scenes["scene_index"])  # candidates of a scene
    own = np.arange(len(samples["robot_index"])) // first * first + samples["robot_index"]
    for name in ROBOT_FIELDS:
        samples[name] = samples[name][own]
    scenes["n_points"][:] = 1 + scenes["n_points"] % run.schema.sizes["point"]
    number = scenes["scene_index"] % HOUSES
    scenes["house_id"] = np.array([f"house-{i}" for i in number], object)
    scenes["house_digest"] = np.array([f"{i:064d}" for i in number], object)
    return scenes, samples

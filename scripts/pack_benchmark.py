"""Pack the first scenes of a benchmark's runs, one small file a run, with a definition of their own.

    python -m scripts.pack_benchmark RUNS OUT [--scenes 100] [--without-labels]

RUNS is the folder of `datagen benchmark make`, OUT a new folder. `datagen benchmark score --runs OUT` and any
Zarr reader open a pack. Equal runs give equal bytes.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from datagen.evaluation.benchmark import (
    DEFINITION,
    Benchmark,
    BenchmarkRun,
    digests_over,
    present_runs,
    read_benchmark,
    refuse_differing,
    truth_field,
)
from datagen.evaluation.columns import EXTRA
from datagen.schemas.errors import InputError
from datagen.schemas.fields import TABLES, RecordSchema, sized_schema
from datagen.schemas.run_records import Layout, SealedPart
from datagen.schemas.safe_files import whole_file
from datagen.schemas.sealing import ZIPPED, consolidated
from datagen.schemas.shard_files import (
    cf_attributes,
    described,
    encode_array,
    root_attributes,
    rows_per_shard,
    zarr_metadata,
    zipped,
)
from datagen.schemas.specification import Specification
from datagen.train.baselines import FIELDS
from datagen.train.batching import SAMPLE_FIELDS, SCENE_FIELDS
from datagen.train.reader import Columns, load_shard
from datagen.train.run_parts import JOIN_FIELDS, RunPart, open_parts
from datagen.train.scene_table import TABLE_FIELDS

# What methods may use and scoring does not read.
_SHOWN = ("distance_m", "T_world_camera", "intrinsics_px", "image_size_px", "object_name", "candidate_index")
_ZSTD_LEVEL = 22  # small rather than fast
_PACKED = {*SCENE_FIELDS, *SAMPLE_FIELDS, *TABLE_FIELDS, *EXTRA, *FIELDS, *_SHOWN}


def write_pack(
    paths: dict[str, str], benchmark: Benchmark, out: Path, scenes: int, with_labels: bool
) -> Iterator[tuple[Path, BenchmarkRun]]:
    """Write the first scenes of the runs at `paths` to a new folder; yield each file and what it holds.

    Runs have equal shares of `scenes`, the first ones one more where they do not divide evenly, or all scenes
    of a shorter run. The definition is written last. InputError for a folder with files or too few scenes.
    """
    if out.is_dir() and any(out.iterdir()):
        raise InputError(out, "--out", "is not empty", "Name a new folder")
    if scenes < len(paths):
        fix = f"Give {len(paths)} or more, a scene a run"
        raise InputError("--scenes", str(scenes), f"is less than the {len(paths)} runs", fix)
    packed: dict[str, BenchmarkRun] = {}
    held = 0
    for k, (name, path) in enumerate(paths.items()):
        part, schema, columns = _first_scenes(path, (scenes + len(paths) - 1 - k) // len(paths))
        truth = truth_field(path, part.specs)
        n, digests = len(columns["sample_id"]), digests_over([columns], truth)
        held += len(columns["scene_index"])
        packed[name] = benchmark.runs[name].model_copy(update={"n": n, "digests": digests})
        if not with_labels:
            kept = tuple(field for field in schema.sample_fields if field.name not in {"label", truth})
            schema = replace(schema, sample_fields=kept)
        sources = part.sources[0]
        file = out / f"{name}{ZIPPED}"
        with whole_file(file) as stream:
            stream.write(encode_store(schema, part.specs[0], sources, columns))
        yield file, packed[name]
    version = f"{benchmark.version[:20]} pack of {held} scenes"
    with whole_file(out / DEFINITION) as stream:
        stream.write(f"{Benchmark(version=version, runs=packed).model_dump_json(indent=1)}\n".encode())


def _first_scenes(path: str, scenes: int) -> tuple[RunPart, RecordSchema, Columns]:
    """The run, the fields that a pack has, and its first whole scenes, at most `scenes`, in stored order."""
    (run,) = open_parts([path], JOIN_FIELDS)
    schema = sized_schema(run.schema, run.specs[0], run.schema_version)
    packed = {*_PACKED, truth_field(path, run.specs)}
    scene, sample = (
        tuple(field for field in fields if field.name in packed)
        for fields in (schema.scene_fields, schema.sample_fields)
    )
    schema = replace(schema, scene_fields=scene, sample_fields=sample)
    (part,) = open_parts([path], [field.name for _, field in schema.fields])
    taken: list[Columns] = []
    for place in part.shards:
        columns, bounds = load_shard(place, part.arrays)
        whole = int((np.diff(bounds) == place.full_samples // place.full_scenes).sum())
        first = min(whole, scenes)
        past = {"scene": first, "sample": bounds[first]}
        taken.append({name: a[: past[part.arrays[name].dims[0]]] for name, a in columns.items()})
        scenes -= first
        if not scenes:
            break
    return part, schema, {name: np.concatenate([each[name] for each in taken]) for name in taken[0]}


def encode_store(
    schema: RecordSchema, spec: Specification, sources: Mapping[str, str], arrays: Columns
) -> bytes:
    """Return the zip of the run's first scenes, all with the same number of candidates.

    It is a store as sealed ones, without files of many chunks. Equal rows give equal bytes.

    `arrays` has the rows of each field of `schema`; `sources` are those of the run's manifest.
    """
    scenes, samples = len(arrays["scene_index"]), len(arrays["sample_scene_index"])
    layout = Layout(scenes_per_shard=scenes, candidates_per_scene=samples // scenes)
    spec_hash = spec.hash()
    part = SealedPart(spec_hash=spec_hash, scenes_per_shard=scenes, n=samples, samples=samples, missing=())
    parts = [{**part.model_dump(mode="json"), "specification": spec.document()}]
    attributes = described([spec], [sources], [samples]) | root_attributes(schema, layout, spec_hash)
    rows = {table: rows_per_shard(layout, table) for table in TABLES}
    of_arrays = {field.name: cf_attributes(field, table) for table, field in schema.fields}
    metadata = zarr_metadata(schema, layout, rows, attributes | {"parts": parts}, of_arrays)
    files = {
        path: json.dumps(json.loads(data), separators=(",", ":")).encode()
        for path, data in consolidated(metadata).items()
    }
    for table, field in schema.fields:
        files |= encode_array(schema, layout, table, field, arrays[field.name], _ZSTD_LEVEL)
    return zipped(files)


def main(words: Sequence[str] | None = None) -> int:
    """Write the pack and print its files; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", type=int, default=100, help="of all runs together, in equal shares")
    parser.add_argument("--without-labels", action="store_true", help="which `score` refuses")
    options = parser.parse_args(words)
    try:
        definition = read_benchmark(options.runs)
        paths = present_runs(str(options.runs), definition)
        for name, path in paths.items():
            refuse_differing(path, name, definition.runs[name], definition.version)
        pack = write_pack(paths, definition, options.out, options.scenes, not options.without_labels)
        for file, run in pack:
            print(f"{file.name}: {run.n:,} candidates, {file.stat().st_size:,} bytes")
    except InputError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Encode scenes of a run as one small file: a sealed store, without files of many chunks, in a zip.

Zarr's ZipStore opens it, and `open_sealed` reads it without its run. Equal rows give equal bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

from datagen.schemas.fields import TABLES, RecordSchema
from datagen.schemas.run_records import Layout, SealedPart
from datagen.schemas.sealing import consolidated
from datagen.schemas.shard_files import (
    Array,
    cf_attributes,
    described,
    encode_array,
    root_attributes,
    rows_per_shard,
    zarr_metadata,
    zipped,
)
from datagen.schemas.specification import Specification

ZIPPED = ".zarr.zip"
_ZSTD_LEVEL = 22  # small rather than fast


def encode_store(
    schema: RecordSchema, spec: Specification, sources: Mapping[str, str], arrays: Mapping[str, Array]
) -> bytes:
    """Return the zip of the run's first scenes, all with the same number of candidates.

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

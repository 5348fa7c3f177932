"""Scenes as tars of WebDataset: cloud, colours and target mask as .npy, record and labels as .json."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from datagen.exports.export_run import SCENES_PER_FILE, ExportSource, Made, NewFile, Step, scene_key
from datagen.schemas.fields import SCHEMAS, Field, RecordSchema, SceneRows
from datagen.train.reader import native

# Members of a scene's sample -> arrays of the cloud.
_CLOUD = {"cloud.npy": "points_m", "rgb.npy": "rgb", "target_mask.npy": "target_mask"}


def steps(source: ExportSource) -> Sequence[Step]:
    """`scenes-000000.tar` and so on."""
    starts = range(source.first, source.past, SCENES_PER_FILE)
    return [partial(_tar, source, number, start) for number, start in enumerate(starts)]


def _tar(source: ExportSource, number: int, start: int, _: Made) -> Iterator[NewFile]:
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for run, rows in source.scenes(start, min(start + SCENES_PER_FILE, source.past)):
            key = scene_key(run.manifest.spec_hash, int(rows.record["scene_index"]))
            for name, data in _members(SCHEMAS[run.schema.name], rows):
                entry = tarfile.TarInfo(f"{key}.{name}")  # without a time or an owner
                entry.size = len(data)
                tar.addfile(entry, io.BytesIO(data))
    yield NewFile(f"scenes-{number:06d}.tar", made.getvalue())


def _members(schema: RecordSchema, rows: SceneRows) -> Iterator[tuple[str, bytes]]:
    for name, field in _CLOUD.items():
        data = io.BytesIO()
        np.save(data, native(rows.record[field][: int(rows.record["n_points"])]))
        yield name, data.getvalue()
    fields = [f for f in schema.scene_fields if f.name not in _CLOUD.values()]
    document = {
        **plain(fields, rows.record),
        "candidates": plain(schema.sample_fields, rows.samples)
        | {"sample_id": [row.tobytes().hex() for row in rows.samples["sample_id"]]},
    }
    yield "json", json.dumps(document).encode()


def plain(fields: Sequence[Field], values: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers and (nested) lists; texts for codes."""
    found = ((f, np.asarray(values[f.name])) for f in fields)
    coded = ((f.name, np.asarray(np.array(f.codes, object)[v] if f.codes else v)) for f, v in found)
    return {name: array.tolist() for name, array in coded}

"""A shard's files are what zarr-python would write, and read back bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
import zarr
from zarr.core.buffer import default_buffer_prototype
from zarr.storage import MemoryStore

from datagen.schemas.errors import InputError
from datagen.schemas.fields import SCHEMAS, Field, sized_schema
from datagen.schemas.run_records import Layout
from datagen.schemas.shard_files import (
    MAX_CHUNK_BYTES,
    chunk_rows,
    encode_shard,
    group_metadata,
    zarr_metadata,
)
from tests.made_runs import small_spec, tables_of

LAYOUT = Layout(scenes_per_shard=3, candidates_per_scene=4)
SCHEMA = sized_schema("heuristic", small_spec())
HASH = "a" * 64
make_buffer = default_buffer_prototype().buffer.from_bytes


def test_the_bytes_are_those_that_zarr_writes():
    scenes, samples = tables_of(SCHEMA, LAYOUT, 0, 0)
    ours = encode_shard(SCHEMA, LAYOUT, HASH, scenes, samples)
    store = {path: make_buffer(data) for path, data in group_metadata(SCHEMA, LAYOUT, HASH).items()}
    group = zarr.open_group(MemoryStore(store), mode="r+")
    for name, values in (*scenes.items(), *samples.items()):
        group[name][:] = values
    assert {path: buffer.to_bytes() for path, buffer in store.items()} == ours


def test_metadata_of_more_rows_are_those_that_zarr_writes_when_an_array_grows():
    attributes = {"said": "größer", "parts": [{"n": 7, "absent": []}]}
    rows = {"scene": 3 * LAYOUT.scenes_per_shard, "sample": 3 * LAYOUT.samples_per_shard - 1}
    store = {path: make_buffer(data) for path, data in group_metadata(SCHEMA, LAYOUT, HASH).items()}
    group = zarr.open_group(MemoryStore(store), mode="r+")
    for name, array in group.arrays():
        table = "scene" if name in {f.name for f in SCHEMA.scene_fields} else "sample"
        array.resize((rows[table], *array.shape[1:]))
    group.attrs.put(attributes)
    theirs = {path: buffer.to_bytes() for path, buffer in store.items()}
    assert zarr_metadata(SCHEMA, LAYOUT, rows, attributes) == theirs


def test_all_zero_chunks_are_written_too():
    scenes, samples = tables_of(SCHEMA, LAYOUT, 0, 0)
    blank = {**scenes, **{k: np.zeros_like(scenes[k]) for k in ("points_m", "rgb", "target_mask")}}
    blank["house_id"] = np.full_like(scenes["house_id"], "")
    files = encode_shard(SCHEMA, LAYOUT, HASH, blank, samples)
    assert set(files) == set(encode_shard(SCHEMA, LAYOUT, HASH, scenes, samples))


@pytest.mark.parametrize("name", SCHEMAS)
def test_no_array_is_named_like_a_dimension_and_none_is_in_both_tables(name: str):
    schema = SCHEMAS[name]
    scene, sample = ({f.name for f in fields} for fields in (schema.scene_fields, schema.sample_fields))
    dims = {"scene", "sample", *(d for f in (*schema.scene_fields, *schema.sample_fields) for d in f.dims)}
    assert not scene & sample
    assert not dims & (scene | sample)
    assert dims - {"scene", "sample"} <= set(schema.sizes)


def test_large_rows_are_cut_into_equal_chunks_below_the_limit():
    points = next(f for f in SCHEMAS["heuristic"].scene_fields if f.name == "points_m")
    for rows in (1, 97, 240, 1000):
        step = chunk_rows(SCHEMAS["heuristic"], points, rows)
        assert rows % step == 0
        assert step == 1 or step * 4096 * 3 * 2 <= MAX_CHUNK_BYTES
    assert chunk_rows(SCHEMAS["heuristic"], points, 240) == 120


@pytest.mark.parametrize(
    ("name", "change", "problem"),
    [
        ("label", lambda a: a[:-1], "shape"),
        ("label", lambda a: a.astype(np.int64), "dtype"),
        ("label", lambda a: a + np.uint8(2), "above 1"),
        ("visibility", lambda a: a * np.float32("nan"), "NaN"),
        ("distance_m", lambda a: a - np.float32(1e4), "below"),
        ("label_source", lambda a: np.array([1] * len(a), object), "is not valid text"),
        ("label_source", lambda a: np.array(["\ud800"] * len(a), object), "is not valid text"),
        ("label_source", lambda a: np.array(["x" * 5000] * len(a), object), "is not valid text"),
    ],
)
def test_a_batch_that_breaks_the_schema_is_refused(name: str, change, problem: str):
    scenes, samples = tables_of(SCHEMA, LAYOUT, 0, 0)
    with pytest.raises(InputError, match=problem) as e:
        encode_shard(SCHEMA, LAYOUT, HASH, scenes, {**samples, name: change(samples[name])})
    assert e.value.field == name


def test_a_missing_and_an_unknown_field_are_named():
    scenes, samples = tables_of(SCHEMA, LAYOUT, 0, 0)
    samples["extra"] = samples.pop("label")
    with pytest.raises(InputError, match="extra, label"):
        encode_shard(SCHEMA, LAYOUT, HASH, scenes, samples)


def test_metadata_follows_the_fields_and_not_only_the_name_of_the_schema():
    more = Field("extra", "float32", (), "m", "", "added in a later version")
    longer = type(SCHEMA)(SCHEMA.name, 2, SCHEMA.scene_fields, (*SCHEMA.sample_fields, more), SCHEMA.sizes)
    assert set(group_metadata(longer, LAYOUT, HASH)) - set(group_metadata(SCHEMA, LAYOUT, HASH)) == {
        "extra/zarr.json"
    }

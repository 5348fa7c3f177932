"""What holds of every run: rows come back bit for bit, however they were cut and committed."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from datagen.schemas.errors import InputError
from datagen.schemas.fields import Field, RecordSchema
from datagen.schemas.run_records import Layout
from datagen.schemas.sealing import seal
from datagen.schemas.shard_files import encode_shard
from datagen.schemas.shard_reading import ZipFiles
from datagen.schemas.stored_arrays import StoredArray, decode_chunk, parse_metadata
from tests.columns import columns_of
from tests.made_runs import make_run

# Every example writes whole runs durably: few examples, short runs.
few = settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.too_slow])
names = st.text(st.characters(exclude_categories=["Cs"]), max_size=50)
DTYPES = ("bool", "uint8", "int16", "int32", "int64", "uint16", "float16", "float32", "float64", "string")


@st.composite
def fields_and_values(draw: st.DrawFn) -> tuple[Field, int, np.ndarray[Any, Any]]:
    dtype = draw(st.sampled_from(DTYPES))
    dims = draw(st.sampled_from([(), ("a",), ("a", "b")]))
    rows = draw(st.integers(1, 6))
    shape = (rows, *({"a": 2, "b": 3}[d] for d in dims))
    if dtype == "string":
        count = int(np.prod(shape))
        texts = draw(st.lists(names, min_size=count, max_size=count))
        values = np.empty(count, object)
        values[:] = texts
        values = values.reshape(shape)
    else:
        kind = np.dtype(dtype)
        finite = {"allow_nan": False, "allow_infinity": False} if kind.kind == "f" else {}
        values = draw(hnp.arrays(kind, shape, elements=hnp.from_dtype(kind, **finite)))
    return Field("value", dtype, dims, "1", "", "anything"), rows, values


def encoded(field: Field, rows: int, values: np.ndarray[Any, Any]) -> tuple[StoredArray, bytes]:
    """The array and its only chunk in the object of a shard of one array."""
    schema = RecordSchema("any", 1, (field,), (), {"a": 2, "b": 3})
    layout = Layout(scenes_per_shard=rows, candidates_per_scene=1)
    files = ZipFiles("place", encode_shard(schema, layout, "0" * 64, {"value": values}, {}))
    (chunk,) = (path for path in files.paths if path.startswith("value/c."))
    return parse_metadata("place", "value", files.get("value/zarr.json")), files.get(chunk)


@given(fields_and_values())
@settings(max_examples=120, deadline=None)
def test_any_valid_batch_comes_back_bit_for_bit(case: tuple[Field, int, np.ndarray[Any, Any]]):
    field, rows, values = case
    array, chunk = encoded(field, rows, values)
    back = decode_chunk("place", array, chunk)
    assert back.shape == values.shape
    if field.is_text:
        assert back.tolist() == values.tolist()
    else:
        assert back.dtype == values.dtype
        assert back.tobytes() == values.tobytes()


@given(fields_and_values(), st.data())
@settings(max_examples=60, deadline=None)
def test_damaged_bytes_never_pass_and_never_crash(case: tuple[Field, int, np.ndarray[Any, Any]], data: Any):
    field, rows, values = case
    array, chunk = encoded(field, rows, values)
    where = data.draw(st.integers(0, len(chunk) - 1))
    end = data.draw(st.integers(where + 1, len(chunk)))
    # Up to four changed bytes in a row are a burst that crc32c always sees.
    new = data.draw(st.binary(min_size=min(4, end - where), max_size=min(4, end - where)))
    damaged = chunk[:where] + new + chunk[where + len(new) :]
    if damaged == chunk:
        damaged = chunk[:-1]
    try:
        decode_chunk("the file", array, damaged)
    except InputError as e:
        assert "the file" in str(e)
    else:
        raise AssertionError("damage went unnoticed")


@given(st.binary(max_size=400))
@settings(max_examples=150, deadline=None)
def test_metadata_of_any_bytes_is_read_or_refused(data: bytes):
    try:
        parse_metadata("place", "value", data)
    except InputError as e:
        assert e.place == "place"
    else:
        raise AssertionError("random bytes are no metadata")


@given(st.integers(1, 40), st.integers(1, 7), st.integers(1, 7))
@few
def test_shard_size_changes_no_sealed_array(n: int, one: int, other: int):
    with tempfile.TemporaryDirectory() as folder:
        groups = [
            zarr.open(seal(make_run(Path(folder) / str(i), n=n, scenes_per_shard=size).storage), mode="r")
            for i, size in enumerate((one, other))
        ]
        assert set(groups[0].array_keys()) == set(groups[1].array_keys())
        for name, array in groups[0].arrays():
            assert array.shape == groups[1][name].shape
            np.testing.assert_array_equal(array[:], groups[1][name][:], err_msg=name)


@given(st.permutations(range(3)), st.permutations(range(3)))
@few
def test_the_order_of_commits_changes_no_byte_of_the_sealed_store(one: list[int], other: list[int]):
    with tempfile.TemporaryDirectory() as folder:
        stores: list[dict[str, bytes]] = []
        for i, order in enumerate((one, other)):
            path = Path(seal(make_run(Path(folder) / str(i), n=27, shards=order).storage))
            stores.append({str(p.relative_to(path)): p.read_bytes() for p in path.rglob("*") if p.is_file()})
        assert stores[0] == stores[1]


@given(st.integers(1, 40), st.integers(1, 4))
@few
def test_shards_have_every_sample_once_in_stored_order(n: int, shard: int):
    with tempfile.TemporaryDirectory() as folder:
        make_run(Path(folder), n=n, scenes_per_shard=shard)
        seen: list[tuple[int, int]] = []
        for b in columns_of(folder, ["candidate_index"]):
            assert (b["scene_index"][b["scene_row"]] == b["sample_scene_index"]).all()
            seen += zip(b["sample_scene_index"].tolist(), b["candidate_index"].tolist(), strict=True)
        assert seen == [(i // 5, i % 5) for i in range(n)]

"""A shard's object is the zip of what zarr-python would write, and reads back; hostile ones are damage."""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import xarray
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from numcodecs.zstd import Zstd
from zarr.core.buffer import default_buffer_prototype
from zarr.storage import MemoryStore, ZipStore

from datagen.schemas.errors import InputError
from datagen.schemas.fields import SCHEMAS, sized_schema
from datagen.schemas.run_records import Layout
from datagen.schemas.sealing import seal
from datagen.schemas.shard_files import (
    MAX_CHUNK_BYTES,
    chunk_rows,
    encode_shard,
    group_metadata,
    with_crc32c,
    zipped,
)
from datagen.schemas.shard_reading import ZipFiles, read_shard
from tests.made_runs import make_run, rows_of, small_spec, tables_of
from tests.schemas.checked import assert_rows, check, commit_object, encoded

LAYOUT = Layout(scenes_per_shard=3, candidates_per_scene=4)
SCHEMA = sized_schema("heuristic", small_spec())
HASH = "a" * 64
make_buffer = default_buffer_prototype().buffer.from_bytes


def files_in(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_stock_zarr_and_xarray_read_the_object_of_a_shard(tmp_path: Path) -> None:
    scenes, samples = tables_of(SCHEMA, LAYOUT, 0, 0)
    path = tmp_path / "shard.zip"
    path.write_bytes(encode_shard(SCHEMA, LAYOUT, HASH, scenes, samples))
    store = ZipStore(path, mode="r")
    group = zarr.open_group(store, mode="r")
    assert_rows({name: np.asarray(array[...]) for name, array in group.arrays()}, scenes | samples)
    assert group.attrs["spec_hash"] == HASH
    data = xarray.open_zarr(store, chunks=None, consolidated=False).load()
    assert_rows({str(name): data[name].values for name in data.variables}, scenes | samples)


def test_its_bytes_are_those_that_zarr_writes_and_always_the_same() -> None:
    scenes, samples = tables_of(SCHEMA, LAYOUT, 0, 0)
    ours = encode_shard(SCHEMA, LAYOUT, HASH, scenes, samples)
    store = {path: make_buffer(data) for path, data in group_metadata(SCHEMA, LAYOUT, HASH).items()}
    group = zarr.open_group(MemoryStore(store), mode="r+")
    for name, values in (*scenes.items(), *samples.items()):
        cast("zarr.Array[Any]", group[name])[:] = values
    assert {path: buffer.to_bytes() for path, buffer in store.items()} == files_in(ours)
    assert encode_shard(SCHEMA, LAYOUT, HASH, dict(reversed(scenes.items())), samples) == ours
    with zipfile.ZipFile(io.BytesIO(ours)) as archive:
        entries = archive.infolist()
    assert {(e.compress_type, e.date_time, e.create_system, e.external_attr) for e in entries} == {
        (zipfile.ZIP_STORED, (1980, 1, 1, 0, 0, 0), 3, 0o600 << 16)
    }
    # Chunks of zeros and of empty names are written too.
    blank = {**scenes, **{k: np.zeros_like(scenes[k]) for k in ("points_m", "rgb", "target_mask")}}
    blank["house_id"] = np.full_like(scenes["house_id"], "")
    assert files_in(encode_shard(SCHEMA, LAYOUT, HASH, blank, samples)).keys() == files_in(ours).keys()


def test_large_rows_are_cut_into_equal_chunks_below_the_limit() -> None:
    points = next(f for f in SCHEMAS["heuristic"].scene_fields if f.name == "points_m")
    for rows in (1, 97, 240, 1000):
        step = chunk_rows(SCHEMAS["heuristic"], points, rows)
        assert rows % step == 0 and (step == 1 or step * 4096 * 3 * 2 <= MAX_CHUNK_BYTES)
    assert chunk_rows(SCHEMAS["heuristic"], points, 240) == 120


def test_labels_of_random_clouds_fit_the_budget(tmp_path: Path) -> None:
    """180,000 labels in 400 MB is 2,222 bytes each; random clouds are the worst case."""
    run = make_run(tmp_path, 600, 10, 60, spec=small_spec(n_points=4096))
    seal(run.storage)
    for folder in ("shards", "data.zarr"):
        assert sum(file.size for file in run.storage.list(folder)) / 600 < 400e6 / 180_000


BROKEN: tuple[tuple[str, Callable[[np.ndarray], np.ndarray] | None, str], ...] = (
    ("label", lambda a: a[:-1], "shape"),
    ("label", lambda a: a.astype(np.int64), "dtype"),
    ("label", None, "missing or unknown"),
    *(
        ("label_source", lambda a, text=text: np.array([text] * len(a), object), "is not valid text")
        for text in (1, "\ud800", "x" * 5000)
    ),
)


@pytest.mark.parametrize(("name", "change", "problem"), BROKEN)
def test_a_batch_that_breaks_the_schema_is_refused(
    name: str, change: Callable[[np.ndarray], np.ndarray] | None, problem: str
) -> None:
    scenes, samples = tables_of(SCHEMA, LAYOUT, 0, 0)
    values = samples.pop(name)
    with pytest.raises(InputError, match=problem) as e:
        encode_shard(SCHEMA, LAYOUT, HASH, scenes, samples | ({name: change(values)} if change else {}))
    assert e.value.field == name


# Hostile objects, whose commit has their digest -----------------------------------------------

Files = Mapping[str, bytes]


def entries(files: Files, method: int = zipfile.ZIP_STORED, *more: tuple[str, bytes]) -> bytes:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", method) as archive:
        for path, data in (*files.items(), *more):
            archive.writestr(path, data)
    return made.getvalue()


def _patched(files: Files, offset: int, value: bytes) -> bytes:
    """The zip, its directory changed at an offset in the entry of a chunk."""
    data = zipped(files)
    at = data.rindex(b"label/c.0") - 46 + offset
    return data[:at] + value + data[at + len(value) :]


def _far_offset(files: Files) -> bytes:
    """The zip, with a chunk at an offset that no file has, in the extra field of Zip64."""
    data, extra = _patched(files, 42, b"\xff" * 4), struct.pack("<HHQ", 1, 8, 2**64 - 1)
    at, end = data.rindex(b"label/c.0"), data.rindex(b"PK\5\6")
    size, start = struct.unpack("<II", data[end + 12 : end + 20])
    directory = data[start : at - 16] + struct.pack("<H", len(extra)) + data[at - 14 : at + 9]
    directory += extra + data[at + 9 : end]
    return data[:start] + directory + data[end : end + 12] + struct.pack("<II", size + 12, start) + b"\0\0"


def _of_other_size(files: Files) -> bytes:
    chunk = with_crc32c(bytes(Zstd(level=3).encode(bytes(3))))
    return zipped({**files, "house_id/c.0": chunk, "points_m/c.0.0.0": chunk})


HOSTILE: dict[str, Callable[[Files], bytes]] = {
    "bzip2": lambda files: entries(files, zipfile.ZIP_BZIP2),
    "encrypted": lambda files: _patched(files, 8, b"\1\0"),
    "truncated": lambda files: zipped(files)[: len(zipped(files)) // 2],
    "offset beyond the file": lambda files: _patched(files, 42, b"\xf0\xff\xff\x7f"),
    "offset beyond any file": _far_offset,
    "bad checksum": lambda files: _patched(files, 16, b"\0" * 4),
    "missing member": lambda files: zipped({k: v for k, v in files.items() if k != "label/c.0"}),
    "small chunk": _of_other_size,
    "other metadata": lambda files: zipped({**files, "label/zarr.json": files["distance_m/zarr.json"]}),
}
ODD: dict[str, Callable[[Files], bytes]] = {  # readers find what they need
    "extra member": lambda files: zipped({**files, "../../odd": b"x"}),
    "two of one name": lambda files: entries(files, zipfile.ZIP_STORED, ("label/c.0", files["label/c.0"])),
    "other metadata of the group": lambda files: zipped({**files, "zarr.json": b"{}"}),
}


@pytest.mark.usefixtures("few_arrays")
@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("kind", [*HOSTILE, *ODD])
def test_hostile_objects_are_damage_that_names_the_object(kind: str, tmp_path: Path) -> None:
    run = make_run(tmp_path, 20, shards=[0])
    data = (HOSTILE | ODD)[kind](files_in(encoded(run, rows_of(run, 1))))
    commit_object(run, 1, data)
    (finding, *more), _ = check(tmp_path)
    assert finding.kind == "rows" and finding.key.startswith("shards/f.zip"), finding
    assert finding.shard == 1 and "--repair" in finding.fix and {f.shard for f in more} <= {1}
    if kind in HOSTILE:
        with pytest.raises(InputError, match=r"shards/f\.zip"):
            read_shard(run, 1)


@settings(max_examples=150)
@given(st.data())
def test_changed_bytes_of_an_object_give_a_line_or_its_files(data: st.DataObject) -> None:
    """As if its digest were right: no other exception."""
    changed = bytearray(encode_shard(SCHEMA, LAYOUT, HASH, *tables_of(SCHEMA, LAYOUT, 0, 0)))
    last, directory = len(changed) - 1, changed.index(b"PK\1\2")
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.one_of(st.integers(0, last), st.integers(directory, last)))
        changed[at] = data.draw(st.integers(0, 255))
    try:
        files = ZipFiles("object", bytes(changed))
        for path in files.paths:
            files.get(path)
    except InputError as e:
        assert e.place.startswith("object") and "\n" not in str(e)

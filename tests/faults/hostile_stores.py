"""Ways to make a run harmful: each is a function from the run's folder, which it changes."""

from __future__ import annotations

import io
import json
import os
import shutil
import zipfile
from collections.abc import Callable, Iterable
from hashlib import sha256
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
from numcodecs.zstd import Zstd

from datagen.schemas.record_files import commit_key, signed_json
from datagen.schemas.run import Run
from datagen.schemas.sealing import store_record
from datagen.schemas.shard_reading import ZipFiles
from tests.made_runs import resign

OBJECT = "shards/a-1.zip"


def replace_by(make: Callable[[Path, Path], None], key: str) -> Callable[[Path], None]:
    """Put something else in the place of a file or a folder of the run."""

    def change(run: Path) -> None:
        path = run / key
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
        make(path, run.parent / "outside")

    return change


def link_to_file(path: Path, outside: Path) -> None:
    path.symlink_to(outside / path.name if (outside / path.name).exists() else outside / "secret")


def link_to_folder(path: Path, outside: Path) -> None:
    path.symlink_to(outside)


def pipe(path: Path, outside: Path) -> None:
    os.mkfifo(path)


def device(path: Path, outside: Path) -> None:
    try:
        os.mknod(path, 0o666 | 0o020000, os.makedev(1, 5))  # endless zeros
    except OSError:
        path.symlink_to("/dev/zero")


def folder(path: Path, outside: Path) -> None:
    path.mkdir()


def committed(path: str, data: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    """Other bytes for a file in the object of shard 1, with a commit that says that it is right."""

    def change(folder: Path) -> None:
        run = Run.open(folder)
        files = ZipFiles("object", run.read_object(run.commit_of(1)))
        resign(run, "a-1", {path: data(files.get(path))})

    return change


def other_object(make: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    """Another object of shard 1, with a commit that says that it is right."""

    def change(folder: Path) -> None:
        data = make((folder / OBJECT).read_bytes())
        (folder / OBJECT).write_bytes(data)
        edited(lambda c: c["object"].update(size=len(data), sha256=sha256(data).hexdigest()))(folder)

    return change


def edited(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    """The commit of shard 1, changed and signed anew."""

    def edit(run: Path) -> None:
        record = Run.open(run).commit_of(1).model_dump(mode="json")
        change(record)
        (run / commit_key(1)).write_bytes(signed_json(record))

    return edit


def zip_of(files: Iterable[tuple[str, bytes]], method: int = zipfile.ZIP_STORED) -> bytes:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", method) as archive:
        for path, data in files:
            archive.writestr(path, data)
    return made.getvalue()


def compressed(data: bytes) -> bytes:
    """Deflated files of 1 GiB under the names of a shard's."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return zip_of([(name, bytes(2**30)) for name in archive.namelist()[:1]], zipfile.ZIP_DEFLATED)


def with_crc(packed: bytes) -> bytes:
    return packed + google_crc32c.value(packed).to_bytes(4, "little")


def declares_terabytes(data: bytes) -> bytes:
    """A zstd frame whose header promises 2^42 bytes."""
    return with_crc(b"\x28\xb5\x2f\xfd\xe0" + (2**42).to_bytes(8, "little") + b"\x01\x00\x00")


def explodes(data: bytes) -> bytes:
    """A true frame of 4 GiB of zeros in some kilobytes: run-length blocks of 128 KiB each."""
    block = ((1 << 17) << 3 | 1 << 1).to_bytes(3, "little") + b"\0"
    last = ((1 << 17) << 3 | 1 << 1 | 1).to_bytes(3, "little") + b"\0"
    return with_crc(b"\x28\xb5\x2f\xfd\xe0" + (2**32).to_bytes(8, "little") + block * (2**15 - 1) + last)


def lies_about_size(data: bytes) -> bytes:
    """The same 4 GiB under a header that promises what the array has."""
    true = int(np.prod((1, 64, 3))) * 2
    block = ((1 << 17) << 3 | 1 << 1).to_bytes(3, "little") + b"\0"
    return with_crc(b"\x28\xb5\x2f\xfd\xe0" + true.to_bytes(8, "little") + block * 2**15)


def many_texts(data: bytes) -> bytes:
    """Vlen text that says it has 2^32 - 1 words."""
    return with_crc(bytes(Zstd().encode(b"\xff\xff\xff\xff" + b"\0" * 40)))


def long_text(data: bytes) -> bytes:
    """One word that says it is 4 GiB long."""
    return with_crc(bytes(Zstd().encode((1).to_bytes(4, "little") + b"\xff\xff\xff\x7f" + b"a" * 10)))


def metadata(change: Callable[[dict[str, Any]], Any]) -> Callable[[bytes], bytes]:
    """A zarr.json with something else in it."""

    def edit(data: bytes) -> bytes:
        value = json.loads(data)
        change(value)
        return json.dumps(value).encode()

    return edit


def many_entries(run: Path) -> None:
    for i in range(20_000):  # what 20,000 killed writers leave
        (run / "commits" / f"{i:06d}.json.part").touch()
    (run / "commits" / "000001.json").write_bytes(b"")


def odd_names(run: Path) -> None:
    for name in ("\x1b[2J\x1b]0;owned\x07", "line\nerror: fake", "\u202ereversed", "ünï", "a\\b", "%2e%2e"):
        (run / "shards" / name).write_bytes(b"")
        (run / "ledger" / f"{name}.json").write_bytes(b"{}")


def deep_json(run: Path) -> None:
    for key in ("commits/000001.json", "ledger/a-1.start.json", "data.json"):
        (run / key).write_bytes(b'{"a":' * 500_000)
    (run / "data.zarr/zarr.json").write_bytes(b"[" * 1_000_000)


def signed_deep_json(run: Path) -> None:
    body = b'{\n "x": ' + b"[" * 200_000 + b"]" * 200_000
    data = body + b',\n "sha256": "' + sha256(body).hexdigest().encode() + b'"\n}\n'
    for key in ("commits/000001.json", "data.json", "plans/1.json", "copies/plans/1.json"):
        (run / key).write_bytes(data)


def huge_json(run: Path) -> None:
    for key in ("commits/000001.json", "ledger/a-1.start.json", "manifest.json", "data.json"):
        with (run / key).open("r+b") as f:
            f.truncate(2**40)


def huge_object(run: Path) -> None:
    with (run / OBJECT).open("r+b") as f:
        f.truncate(2**40)
    edited(lambda commit: commit["object"].update(size=2**40))(run)


def edited_store(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    """The record of the sealed store, changed and signed anew."""

    def edit(run: Path) -> None:
        record = store_record(Run.open(run).storage)
        assert record is not None
        fields = record.model_dump(mode="json")
        change(fields)
        (run / "data.json").write_bytes(signed_json(fields))

    return edit


def a_store_of_links(run: Path) -> None:
    """The record names a store that is a link, and files below and above it."""
    (run / "data-2.zarr").symlink_to(run.parent / "outside")
    edited_store(lambda record: record.update(name="data-2.zarr"))(run)


HOSTILE: dict[str, Callable[[Path], None]] = {
    "object linked outside": replace_by(link_to_file, OBJECT),
    "shards linked outside": replace_by(link_to_folder, "shards"),
    "commits linked outside": replace_by(link_to_folder, "commits"),
    "ledger linked outside": replace_by(link_to_folder, "ledger"),
    "manifest linked outside": replace_by(link_to_file, "manifest.json"),
    "plans linked outside": replace_by(link_to_folder, "plans"),
    "sealed store linked outside": replace_by(link_to_folder, "data.zarr"),
    "sealed root linked outside": replace_by(link_to_file, "data.zarr/zarr.json"),
    "store record linked outside": replace_by(link_to_file, "data.json"),
    "a store of links": a_store_of_links,
    "pipe for an object": replace_by(pipe, OBJECT),
    "pipe for a manifest": replace_by(pipe, "manifest.json"),
    "pipe for a commit": replace_by(pipe, commit_key(1)),
    "pipe for a start": replace_by(pipe, "ledger/a-1.start.json"),
    "pipe for a sealed file": replace_by(pipe, "data.zarr/label/c.0"),
    "pipe for a store record": replace_by(pipe, "data.json"),
    "device for an object": replace_by(device, OBJECT),
    "device for a commit": replace_by(device, commit_key(1)),
    "folder for an object": replace_by(folder, OBJECT),
    "folder for a commit": replace_by(folder, commit_key(1)),
    "frame of terabytes": committed("points_m/c.0.0.0", declares_terabytes),
    "frame that explodes": committed("points_m/c.0.0.0", explodes),
    "frame that lies": committed("points_m/c.0.0.0", lies_about_size),
    "text without end": committed("house_id/c.0", many_texts),
    "one long text": committed("house_id/c.0", long_text),
    "huge shape": committed("label/zarr.json", metadata(lambda m: m.update(shape=[2**60]))),
    "huge chunks": committed(
        "label/zarr.json", metadata(lambda m: m["chunk_grid"]["configuration"].update(chunk_shape=[2**50]))
    ),
    "objects": committed("label/zarr.json", metadata(lambda m: m.update(data_type="object"))),
    "pickles": committed("label/zarr.json", metadata(lambda m: m["codecs"].insert(0, {"name": "pickle"}))),
    "other codecs": committed("label/zarr.json", metadata(lambda m: m.update(codecs=[{"name": "gzip"}]))),
    "deep metadata": committed("label/zarr.json", lambda data: b"[" * 200_000),
    "object outside": edited(lambda c: c["object"].update(path="../../../../outside/secret")),
    "object at the root": lambda run: edited(
        lambda c: c["object"].update(path=str(run.parent / "outside" / "secret"))
    )(run),
    "attempt outside": edited(lambda c: c.update(attempt="../../../outside")),
    "20,000 files": other_object(lambda data: zip_of((f"x/{i}", b"") for i in range(20_000))),
    "files outside": other_object(lambda data: zip_of([("../../outside/secret", b"x"), ("/etc/x", b"x")])),
    "compressed files": other_object(compressed),
    "no zip": other_object(lambda data: b"PK" * 10_000),
    "huge object": huge_object,
    "store outside": edited_store(lambda r: r.update(name="../outside")),
    "sealed file outside": edited_store(lambda r: r["files"][0].update(path="../../outside/secret")),
    "huge sealed file": edited_store(lambda r: r["files"][0].update(size=2**40)),
    "deep JSON": deep_json,
    "deep JSON, signed": signed_deep_json,
    "huge JSON": huge_json,
    "20,000 entries": many_entries,
    "odd names": odd_names,
}

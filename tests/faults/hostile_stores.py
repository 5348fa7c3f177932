"""Ways to make a run harmful: each is a function from the run's folder, which it changes."""

from __future__ import annotations

import json
import os
import shutil
import zlib
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
from numcodecs.zstd import Zstd

from datagen.schemas.record_files import commit_copy_key, commit_key, signed_json
from datagen.schemas.run import Run

ATTEMPT = "shards/000001/a-1"


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


def committed(key: str, data: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    """Other bytes in a file of shard 1, with commit, copy and signature that say that it is right."""

    def change(run: Path) -> None:
        path = run / ATTEMPT / key
        path.chmod(0o644)
        written = data(path.read_bytes())
        path.write_bytes(written)
        record = Run.open(run).commit_of(1).model_dump(mode="json")
        for entry in record["files"]:
            if entry["path"] == key:
                entry["size"], entry["sha256"] = len(written), sha256(written).hexdigest()
        sign(run, record)

    return change


def sign(run: Path, record: dict[str, Any]) -> None:
    for key in (commit_key(1), commit_copy_key(1, "a-1")):
        (run / key).write_bytes(signed_json(record))


def edited(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    """The commit of shard 1 and its copy, changed and signed anew."""

    def edit(run: Path) -> None:
        record = Run.open(run).commit_of(1).model_dump(mode="json")
        change(record)
        sign(run, record)

    return edit


def file_at_the_root(run: Path) -> None:
    secret = str(run.parent / "outside" / "secret")
    edited(lambda commit: commit["files"][0].update(path=secret))(run)


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
        (run / ATTEMPT / name).write_bytes(b"")
        (run / "ledger" / f"{name}.json").write_bytes(b"{}")


def deep_json(run: Path) -> None:
    for key in ("commits/000001.json", f"{ATTEMPT}/commit.json", "ledger/a-1.json"):
        (run / key).write_bytes(b'{"a":' * 500_000)
    (run / "data.zarr/zarr.json").chmod(0o644)
    (run / "data.zarr/zarr.json").write_bytes(b"[" * 1_000_000)


def signed_deep_json(run: Path) -> None:
    body = b'{\n "x": ' + b"[" * 200_000 + b"]" * 200_000
    data = body + b',\n "sha256": "' + sha256(body).hexdigest().encode() + b'"\n}\n'
    for key in ("commits/000001.json", f"{ATTEMPT}/commit.json", "plans/1.json", "copies/plans/1.json"):
        (run / key).write_bytes(data)


def huge_json(run: Path) -> None:
    for key in ("commits/000001.json", "ledger/a-1.json", "manifest.json"):
        with (run / key).open("r+b") as f:
            f.truncate(2**40)


def huge_chunk(run: Path) -> None:
    with (run / ATTEMPT / "rgb/c.0.0.0").open("r+b") as f:
        f.truncate(2**40)

    def claim(commit: dict[str, Any]) -> None:
        next(e for e in commit["files"] if e["path"] == "rgb/c.0.0.0")["size"] = 2**40

    edited(claim)(run)


def a_table_that_explodes(run: Path) -> None:
    (run / "index").mkdir(exist_ok=True)
    (run / "index/1.json.gz").write_bytes(zlib.compress(b"\0" * 2**28, wbits=31))
    (run / "plans/1.json").write_bytes(b"")


HOSTILE: dict[str, Callable[[Path], None]] = {
    "chunk linked outside": replace_by(link_to_file, f"{ATTEMPT}/label/c.0"),
    "array linked outside": replace_by(link_to_folder, f"{ATTEMPT}/label"),
    "attempt linked outside": replace_by(link_to_folder, ATTEMPT),
    "shards linked outside": replace_by(link_to_folder, "shards"),
    "commits linked outside": replace_by(link_to_folder, "commits"),
    "ledger linked outside": replace_by(link_to_folder, "ledger"),
    "manifest linked outside": replace_by(link_to_file, "manifest.json"),
    "plans linked outside": replace_by(link_to_folder, "plans"),
    "sealed store linked outside": replace_by(link_to_folder, "data.zarr"),
    "sealed root linked outside": replace_by(link_to_file, "data.zarr/zarr.json"),
    "pipe for a chunk": replace_by(pipe, f"{ATTEMPT}/label/c.0"),
    "pipe for a manifest": replace_by(pipe, "manifest.json"),
    "pipe for a commit": replace_by(pipe, commit_key(1)),
    "pipe for an account": replace_by(pipe, "ledger/a-1.json"),
    "pipe for a sealed chunk": replace_by(pipe, "data.zarr/label/c.1"),
    "device for a chunk": replace_by(device, f"{ATTEMPT}/points_m/c.0.0.0"),
    "device for a commit": replace_by(device, commit_key(1)),
    "folder for a chunk": replace_by(folder, f"{ATTEMPT}/label/c.0"),
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
    "file outside": edited(lambda c: c["files"][0].update(path="../../../../outside/secret")),
    "file at the root": file_at_the_root,
    "attempt outside": edited(lambda c: c.update(attempt="../../../outside")),
    "20,000 files": edited(
        lambda c: c.update(files=[{"path": f"x/{i}", "size": 0, "sha256": "0" * 64} for i in range(20_000)])
    ),
    "huge chunk": huge_chunk,
    "deep JSON": deep_json,
    "deep JSON, signed": signed_deep_json,
    "huge JSON": huge_json,
    "table that explodes": a_table_that_explodes,
    "20,000 entries": many_entries,
    "odd names": odd_names,
}

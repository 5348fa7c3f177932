"""Download assets of the catalogue into a folder with a lock file.

`assets.lock.json` lists each download's address, digest, size and licence. A download whose publisher states
no digest is trusted on first use: its digest is recorded there, and later fetches must match it.
"""

from __future__ import annotations

import hashlib
import http.client
import json
import os
import shutil
import tarfile
import tempfile
import time
import urllib.error
import urllib.parse
import urllib.request
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

from pydantic import Field, ValidationError

from datagen.assets.catalogue import CatalogueEntry
from datagen.schemas.errors import InputError
from datagen.schemas.run_records import Digest, StoredRecord
from datagen.schemas.safe_files import DAMAGED_ZIP, is_inside, open_regular, read_regular, whole_file
from datagen.workers.source_statement import STATEMENT

LOCK_NAME = "assets.lock.json"
_MAX_LOCK_BYTES = 2**20
_MAX_FILE_BYTES = 2**40


class LockedDownload(StoredRecord):
    """One fetched file or archive. `trust` is the origin of the digest."""

    name: str
    url: str
    sha256: Digest
    size: Annotated[int, Field(ge=0, le=2**50)]
    licence: str
    trust: Literal["published", "first-use"]


class Lock(StoredRecord):
    """The content of a lock file."""

    version: Literal[1] = 1
    downloads: tuple[LockedDownload, ...] = ()


@dataclass(frozen=True)
class Fetched:
    """The result for one asset."""

    name: str
    sha256: str
    size: int
    trust: str  # "published" or "first-use"
    from_cache: bool
    files: int


def read_lock(folder: Path) -> Lock:
    """The folder's lock file, empty where there is none. Raises InputError for a damaged one."""
    path = folder / LOCK_NAME
    if not path.exists():
        return Lock()
    fix = "Restore it, or remove it to trust the next downloads"
    try:
        return Lock.model_validate_json(read_regular(path, _MAX_LOCK_BYTES, fix))
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(path, ".".join(map(str, first["loc"])), first["msg"], fix) from error


def fetch(
    asset: CatalogueEntry,
    folder: Path,
    *,
    cache: Path,
    mirror: str | None = None,
    progress: Progress = lambda here, total: None,
) -> Fetched:
    """Download one asset, or take it from the cache, unpack it and record it in the lock file.

    `mirror` replaces the address before the file name. Raises InputError as `download` and `unpack` do.
    """
    lock = read_lock(folder)
    recorded = next((d.sha256 for d in lock.downloads if d.name == asset.name), None)
    expected = asset.sha256 or recorded
    kept = cache / asset.file
    digest = _sha256_of(kept) if kept.is_file() else None
    from_cache = digest is not None and expected in (None, digest)
    if digest is None or not from_cache:
        digest = download(
            f"{mirror.rstrip('/')}/{asset.file}" if mirror else asset.url,
            kept,
            sha256=expected,
            size=asset.size,
            progress=progress,
        )
    size = kept.stat().st_size
    files = _install(asset, kept, folder)
    _state(asset, folder / PurePosixPath(asset.holds or asset.into))
    entry = LockedDownload(
        name=asset.name,
        url=asset.url,
        sha256=digest,
        size=size,
        licence=asset.licence,
        trust="published" if asset.sha256 else "first-use",
    )
    downloads = {old.name: old for old in lock.downloads} | {entry.name: entry}
    lock = Lock(downloads=tuple(downloads[name] for name in sorted(downloads)))
    with whole_file(folder / LOCK_NAME, durable=True) as file:
        file.write(json.dumps(lock.model_dump(), indent=1, sort_keys=True).encode() + b"\n")
    return Fetched(asset.name, digest, size, entry.trust, from_cache, files)


def _install(asset: CatalogueEntry, kept: Path, folder: Path) -> int:
    """Copy or unpack the download; return the number of its files."""
    home = folder / PurePosixPath(asset.into)
    if asset.file.endswith((".zip", ".tgz")):
        return unpack(kept, home)
    with kept.open("rb") as source, whole_file(home / asset.file, alone=True) as file:
        shutil.copyfileobj(source, file)
    return 1


def unpack(archive: Path, folder: Path) -> int:
    """Unpack the files of a zip or tar into `folder`, over those of the same names; return their number.

    They are moved when the whole archive is unpacked, so that a damaged one leaves nothing. No name leads out
    of the folder, and links and devices are left out. Raises InputError for an archive that is damaged or
    without a file, and removes it: the next fetch downloads it again.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".unpack-", dir=folder) as staging:
        try:
            if zipfile.is_zipfile(archive):
                with zipfile.ZipFile(archive) as packed:
                    packed.extractall(staging)
            else:
                _unpack_tar(archive, Path(staging))
            if not (files := [path for path in Path(staging).rglob("*") if path.is_file()]):
                raise tarfile.ReadError("it has no file")
        except (tarfile.TarError, *DAMAGED_ZIP) as error:
            archive.unlink(missing_ok=True)
            fix = "Fetch it again, or give another --mirror"
            raise InputError(archive, "", f"cannot be unpacked, and is removed: {error}", fix) from error
        for file in files:
            target = folder / file.relative_to(staging)
            target.parent.mkdir(parents=True, exist_ok=True)
            file.replace(target)
    return len(files)


def _unpack_tar(archive: Path, folder: Path) -> None:
    # Not by extractall, whose filter for names that lead out came with Python 3.11.4.
    with tarfile.open(archive) as packed:
        for member in packed:
            target = folder / member.name
            if member.isreg() and is_inside(folder, target) and (source := packed.extractfile(member)):
                target.parent.mkdir(parents=True, exist_ok=True)
                with target.open("wb") as file:
                    shutil.copyfileobj(source, file)


def _state(asset: CatalogueEntry, home: Path) -> None:
    """Write the folder's statement, which runs copy, unless it has one."""
    if asset.title and home.is_dir() and not (home / STATEMENT).exists():
        stated = {"title": asset.title, "licence": asset.licence, "attribution": asset.attribution}
        with whole_file(home / STATEMENT, alone=True) as file:
            file.write(json.dumps(stated, indent=1).encode() + b"\n")


def _sha256_of(path: Path) -> str:
    with open_regular(path, _MAX_FILE_BYTES, "Remove the file, and fetch it again") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


_CHUNK_BYTES = 2**18
_TRIES = 6  # in a row without a new byte
_LONGEST_PAUSE_S = 30.0
_TIMEOUT_S = 30.0

# (bytes here so far, total or None). Also called when a download starts over.
Progress = Callable[[int, int | None], None]


def download(url: str, target: Path, *, sha256: str | None, size: int | None, progress: Progress) -> str:
    """Download `url` to the file `target` and return its sha256.

    An interrupted download (`<target>.part`) continues with a range request, tied to the same content by its
    ETag; where the server has no strong ETag or the content changed, it starts over. Dropped connections and
    errors of the server are retried with growing pauses. A complete file of this digest and size, where
    given, is renamed atomically. Raises InputError for final responses such as 404, another size or digest,
    and after the last try.
    """
    if urllib.parse.urlsplit(url).scheme not in ("http", "https"):
        raise InputError(url, "", "is not an http(s) address", "Give one with --mirror")
    target.parent.mkdir(parents=True, exist_ok=True)
    part, etag = (target.with_name(target.name + ending) for ending in (".part", ".part.etag"))
    failures = most = 0
    while True:
        try:
            _continue(url, part, etag, progress)
            break
        except (OSError, http.client.HTTPException) as error:
            status = error.code if isinstance(error, urllib.error.HTTPError) else 500
            if status == 416:  # the part is as long as the content, or longer
                part.unlink()
            elif status < 500 and status not in (408, 429):
                fix = "Give --mirror with a server that has it"
                raise InputError(url, "", f"the server responds {error}", fix) from error
            here = part.stat().st_size if part.exists() else 0
            failures, most = (failures + 1, most) if here <= most else (0, here)
            if failures == _TRIES:
                fix = "Run the command again to continue, or use --mirror"
                raise InputError(url, "", f"gave up after {_TRIES} tries ({error})", fix) from error
            time.sleep(min(_LONGEST_PAUSE_S, 0.5 * 2**failures))
    with part.open("rb") as file:
        os.fsync(file.fileno())
        digest, got = hashlib.file_digest(file, "sha256").hexdigest(), file.tell()
    etag.unlink(missing_ok=True)
    if size not in (None, got) or sha256 not in (None, digest):
        part.unlink()
        wrong = f"{got:,} bytes with the sha256 {digest}"
        fix = "Fetch it again, use another --mirror, or report the change"
        raise InputError(url, "", f"is not the expected file, but {wrong}", fix)
    part.replace(target)
    return digest


def _continue(url: str, part: Path, etag: Path, progress: Progress) -> None:
    """Append to the part, or begin it, until the body ends. OSError where it ends too early."""
    here = part.stat().st_size if part.exists() and etag.exists() else 0
    headers = {"User-Agent": "datagen", "Accept-Encoding": "identity"}
    if here:
        headers |= {"Range": f"bytes={here}-", "If-Range": etag.read_text("utf-8")}
    with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=_TIMEOUT_S) as answer:  # noqa: S310
        if answer.status != 206:
            here = 0
            part.unlink(missing_ok=True)
            etag.unlink(missing_ok=True)
            # A weak one, W/"...", may name other bytes.
            if (tag := answer.headers.get("ETag", "")).startswith('"'):
                etag.write_text(tag, "utf-8")
        total = None if answer.length is None else here + answer.length
        progress(here, total)
        with part.open("ab") as out:
            while chunk := answer.read(_CHUNK_BYTES):
                out.write(chunk)
                here += len(chunk)
                progress(here, total)
    if total is not None and here < total:
        raise ConnectionError(f"the connection broke at {here:,} of {total:,} bytes")

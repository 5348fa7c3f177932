"""One download over HTTP: resumed, checked, and renamed only when complete."""

from __future__ import annotations

import hashlib
import http.client
import os
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable
from pathlib import Path

from datagen.schemas.errors import InputError

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

"""One download over HTTP: resumed, limited in size, checked, and renamed only when complete."""

from __future__ import annotations

import hashlib
import http.client
import json
import os
import re
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import read_regular

_CHUNK_BYTES = 2**18
_CONTENT_RANGE = re.compile(r"bytes (\d+)-\d+/(?:\d+|\*)")
# Responses worth a retry; other 4xx are final.
_TRANSIENT = {408, 425, 429, 500, 502, 503, 504}

# (bytes here so far, total or None). Also called when a download starts over.
Progress = Callable[[int, int | None], None]


@dataclass(frozen=True)
class DownloadPolicy:
    """Timeouts and retries of a download. `pause` waits between tries."""

    tries: int = 6  # in a row without a new byte
    first_pause_s: float = 0.5
    longest_pause_s: float = 30.0
    timeout_s: float = 30.0
    pause: Callable[[float], None] = field(default=time.sleep)


class _TransientFailure(Exception):
    """A failure worth another try."""


class _HttpOnly(urllib.request.HTTPRedirectHandler):
    """Follows redirects to http(s) only, and never from https to http."""

    def redirect_request(self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str) -> Any:
        allowed = ("https",) if req.type == "https" else ("http", "https")
        if urllib.parse.urlsplit(newurl).scheme not in allowed:
            raise InputError(req.full_url, "", f"redirects to {newurl[:100]}", "Use another --mirror")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


_OPENER = urllib.request.build_opener(_HttpOnly)


def download(
    url: str,
    target: Path,
    *,
    sha256: str | None,
    size: int | None,
    max_bytes: int,
    progress: Progress,
    policy: DownloadPolicy | None = None,
) -> str:
    """Download `url` to the file `target` and return its sha256.

    An interrupted download (`<target>.part`) continues with a range request, tied to the same content by
    If-Range; where the server supports no ranges or the content changed, it starts over. Dropped connections
    and 5xx responses are retried with growing pauses. A complete file with the digest `sha256` (where given)
    is renamed atomically. Raises InputError for final responses such as 404, more than `max_bytes`, a wrong
    size or digest, and after the last try.
    """
    policy = policy or DownloadPolicy()
    if urllib.parse.urlsplit(url).scheme not in ("http", "https"):
        raise InputError(url, "", "is not an http(s) address", "Give one with --mirror")
    target.parent.mkdir(parents=True, exist_ok=True)
    part = _PartialFile(target, url)
    failures, most = 0, part.length
    while True:
        resumed = part.length > 0
        try:
            _transfer(url, part, size, max_bytes, sha256 is not None, progress, policy.timeout_s)
        except _TransientFailure as error:
            # A download that starts over has made no progress before it is longer than ever.
            failures, most = (0, part.length) if part.length > most else (failures + 1, most)
            if failures >= policy.tries:
                raise InputError(
                    url,
                    "",
                    f"gave up after {failures} tries ({error})",
                    "Run the command again to continue, or use --mirror",
                ) from error
            policy.pause(min(policy.longest_pause_s, policy.first_pause_s * 2**failures))
            continue
        digest = part.digest()
        if (size is None or part.length == size) and (sha256 is None or digest == sha256):
            part.finish()
            return digest
        got = part.length
        part.discard()
        # The two parts of a resumed file may come from two versions: download it again.
        if not resumed:
            wrong = (
                f"{got:,} bytes, not {size:,}"
                if size not in (None, got)
                else f"sha256 {digest}, not {sha256}"
            )
            raise InputError(
                url, "", f"is not the expected file: {wrong}", "Use another --mirror, or report the change"
            )


class _PartialFile:
    """The unfinished file and the validator of its content."""

    def __init__(self, target: Path, url: str) -> None:
        self._target, self._url = target, url
        self.path = target.with_name(target.name + ".part")
        self._note = target.with_name(target.name + ".part.json")
        self.validator = ""
        try:
            note = json.loads(read_regular(self._note, 2**16, ""))
            if note["url"] == url and isinstance(note["validator"], str) and note["validator"].isprintable():
                self.validator = note["validator"]
            else:
                self.discard()
        except (ValueError, KeyError, TypeError, RecursionError):
            self.discard()

    @property
    def length(self) -> int:
        return self.path.stat().st_size if self.path.exists() else 0

    def note(self, validator: str) -> None:
        self.validator = validator
        self._note.write_text(json.dumps({"url": self._url, "validator": validator}), "utf-8")

    def digest(self) -> str:
        with self.path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def discard(self) -> None:
        self.path.unlink(missing_ok=True)
        self._note.unlink(missing_ok=True)
        self.validator = ""

    def finish(self) -> None:
        with self.path.open("rb") as file:
            os.fsync(file.fileno())
        self.path.replace(self._target)
        self._note.unlink(missing_ok=True)


def _transfer(
    url: str,
    part: _PartialFile,
    size: int | None,
    max_bytes: int,
    has_digest: bool,
    progress: Progress,
    timeout_s: float,
) -> None:
    """One request that appends to the part until the body ends. Raises _TransientFailure or InputError."""
    start = part.length
    # Without a validator, only a known digest can show that both parts belong together.
    if start and not (part.validator or has_digest):
        part.discard()
        start = 0
    if size is not None and start == size:
        return
    headers = {"User-Agent": "datagen", "Accept-Encoding": "identity"}
    if start:
        headers["Range"] = f"bytes={start}-"
        if part.validator:
            headers["If-Range"] = part.validator
    try:
        with _OPENER.open(urllib.request.Request(url, headers=headers), timeout=timeout_s) as answer:  # noqa: S310
            if start and not _continues(answer, start):
                part.discard()
                start = 0
            total = None if answer.length is None else start + answer.length
            if max(total or 0, size or 0) > max_bytes or (None not in (size, total) and total != size):
                part.discard()
                wanted = f"at most {max_bytes:,}" if size is None else f"{size:,}"
                raise InputError(
                    url, "", f"the file has {total or size:,} bytes, not {wanted}", "Use another --mirror"
                )
            if not start:
                part.note(_validator(answer))
            _append(answer, part, url, start, total if total is not None else size, max_bytes, progress)
    except urllib.error.HTTPError as error:
        error.close()
        if error.code == 416:
            part.discard()
            raise _TransientFailure("the server refused to continue") from error
        if error.code in _TRANSIENT:
            raise _TransientFailure(f"HTTP {error.code}") from error
        raise InputError(
            url,
            "",
            f"the server responds HTTP {error.code} {error.reason}",
            "Give --mirror with a server that has it",
        ) from error
    except (urllib.error.URLError, http.client.HTTPException, ConnectionError, TimeoutError) as error:
        raise _TransientFailure(str(getattr(error, "reason", "") or error) or type(error).__name__) from error


def _continues(answer: Any, start: int) -> bool:
    match = _CONTENT_RANGE.fullmatch(answer.headers.get("Content-Range", ""))
    return answer.status == 206 and match is not None and int(match[1]) == start


def _validator(answer: Any) -> str:
    """The validator for If-Range: a strong ETag, or else the modification time."""
    etag = answer.headers.get("ETag", "")
    return etag if etag and not etag.startswith("W/") else answer.headers.get("Last-Modified", "")


def _append(
    answer: Any,
    part: _PartialFile,
    url: str,
    start: int,
    total: int | None,
    max_bytes: int,
    progress: Progress,
) -> None:
    here = start
    progress(here, total)
    with part.path.open("ab" if start else "wb") as out:
        while chunk := answer.read(_CHUNK_BYTES):
            here += len(chunk)
            if here > max_bytes:
                out.close()
                part.discard()
                raise InputError(
                    url, "", f"the server sends more than {max_bytes:,} bytes", "Use another --mirror"
                )
            out.write(chunk)
            progress(here, total)
    if total is not None and here < total:
        raise _TransientFailure(f"the connection broke at {here:,} of {total:,} bytes")

"""Objects below a prefix of an S3 bucket, through obstore, with bounded retries.

The client's own retries are off, so that one rule holds for every request: transient failures are retried
with growing pauses until `PATIENCE` timeouts have passed, in a job for minutes or until it is
stopped. Others are raised at once.
"""

from __future__ import annotations

import os
import random
import re
import time
from collections.abc import Callable, Iterable, Iterator
from datetime import timedelta
from itertools import islice
from typing import Any, TypeVar
from urllib.parse import urlsplit

import obstore
from obstore.exceptions import AlreadyExistsError, BaseError
from obstore.store import S3Store

from datagen.schemas.errors import InputError
from datagen.schemas.storage.errors import (
    RequestFailure,
    last_repetition_s,
    store_trouble,
    tell_repetition,
    too_large,
    waits_s,
)
from datagen.schemas.storage.local_files import StoredFile

TIMEOUT_S = 20.0  # seconds without a response after which a request fails
_TRUE = ("true", "1", "yes", "on")
_BUCKET = re.compile(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]")
_ENDPOINTS = ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT")
# Connection settings in the environment, which the client ignores once it has explicit ones.
_CONNECTION = ("allow_http", "allow_invalid_certificates", "proxy_url", "proxy_excludes")


def connection_settings() -> dict[str, object]:
    """Connection settings such as AWS_ALLOW_HTTP, by the client's names."""
    given = {name: os.environ.get(f"AWS_{name.upper()}", "") for name in _CONNECTION}
    return {
        name: value if name.startswith("proxy") else value.lower() in _TRUE
        for name, value in given.items()
        if value
    }


def timeout_s() -> float:
    """Timeout of a request in seconds: DATAGEN_STORE_TIMEOUT_S, or 20."""
    given = os.environ.get("DATAGEN_STORE_TIMEOUT_S", "")
    try:
        seconds = float(given or TIMEOUT_S)
    except ValueError:
        seconds = 0.0
    if not 0.1 <= seconds <= 3600:
        fix = "Give the timeout of the object store in seconds, 0.1 to 3600"
        raise InputError("DATAGEN_STORE_TIMEOUT_S", given[:40], "is not a valid timeout", fix)
    return seconds


def bucket_and_prefix(url: str) -> tuple[str, str]:
    """(bucket, prefix) of an s3:// address; InputError for a bad address or endpoint."""
    bucket, _, prefix = url.removeprefix("s3://").partition("/")
    prefix = prefix.rstrip("/")
    fix = "Give s3://bucket/prefix"
    if "@" in bucket or "?" in url or "#" in url:
        # Not shown: it may contain a key.
        problem = "has more than a bucket and a prefix"
        raise InputError("the s3:// address", "", problem, f"{fix}, and keys in AWS_* variables")
    if not _BUCKET.fullmatch(bucket):
        fix = f"{fix}, with 3 to 63 small letters, digits, dots and hyphens for the bucket"
        raise InputError(url[:200], "", "does not name a bucket", fix)
    if prefix and any(part in ("", ".", "..") for part in prefix.split("/")):
        raise InputError(url[:200], "", "has an empty part, or a part of dots", fix)
    _refuse_endpoint()
    return bucket, prefix


def _refuse_endpoint() -> None:
    """Raise InputError for a bad endpoint, on which the client would panic."""
    for name in _ENDPOINTS:
        given = os.environ.get(name, "")
        if not given:
            continue
        try:
            split = urlsplit(given)
            usable = split.scheme in ("http", "https") and bool(split.hostname) and split.port != 0
            usable = usable and split.username is None and given.isascii() and given.isprintable()
        except ValueError:
            usable = False
        if not usable or " " in given:
            fix = "Give http(s)://HOST:PORT of the store, without keys"
            raise InputError(name, "", "is not the address of a store", fix)
        if given.lower().startswith("http:") and not connection_settings().get("allow_http"):
            raise InputError(name, "", "is not encrypted (http)", "Set AWS_ALLOW_HTTP=true to allow it")


PATIENCE = 1.5  # timeouts for which a request is retried, at least once
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 3.0
_TOLD_AFTER = 6  # tries, some seconds: short failures are no news
_SLOW_LINE = 125_000  # bytes per second, on which objects can still be written
_DELETED_AT_ONCE = 1000  # limit of S3 per request
_FAILURES = (BaseError, OSError, ValueError)

Result = TypeVar("Result")


class RemoteObjects:
    """The methods of `Storage` for `s3://bucket/prefix`. A failure is an `InputError` with the object."""

    def __init__(self, url: str) -> None:
        self.bucket, self.prefix = bucket_and_prefix(url)
        self.url = f"s3://{self.bucket}/{self.prefix}".rstrip("/")
        self._timeout_s = timeout_s()
        self._stores = dict[int, Any]()
        self._store = self._sending(0)

    def below(self, key: str) -> RemoteObjects:
        return RemoteObjects(f"{self.url}/{key}")

    def put(self, key: str, data: bytes, durably: bool) -> None:
        self._try(key, lambda: obstore.put(self._sending(len(data)), key, data, use_multipart=False))

    def create(self, key: str, data: bytes) -> bool:
        """Write an object unless the name exists; False where it does.

        Also False where a first request wrote the object but responded with an error, and was retried.
        """

        def put() -> bool:
            try:
                obstore.put(self._sending(len(data)), key, data, mode="create", use_multipart=False)
            except AlreadyExistsError as e:
                # Also the response while another request for this name is running, which may fail.
                if "409 Conflict" in str(e) and not self.exists(key):
                    raise _TransientTrouble("the store responds 409") from e
                return False
            return True

        return self._try(key, put)

    def get(self, key: str, limit_bytes: int) -> bytes | None:
        def get() -> bytes:
            found = obstore.get(self._store, key)
            size = int(found.meta["size"])
            if size > limit_bytes:
                raise too_large(f"{self.url}/{key}", size, limit_bytes)
            data = bytes(found.bytes())
            if len(data) != size:
                raise _TransientTrouble("the store's response is cut off")
            return data

        return self._found(key, get)

    def get_range(self, key: str, start: int, size: int) -> bytes | None:
        part: Any = {"range": (start, start + size) if start >= 0 else {"suffix": -start}}

        def get() -> bytes:
            try:
                return bytes(obstore.get(self._store, key, options=part).bytes())
            except BaseError as e:
                if "status code: 416" in str(e):  # the object ends before
                    return b""
                raise

        return self._found(key, get)

    def exists(self, key: str) -> bool:
        return self._found(key, lambda: obstore.head(self._store, key)) is not None

    def list(self, prefix: str) -> Iterator[StoredFile]:
        """All objects below a prefix (without its closing slash), in order of their keys."""
        last: str | None = None
        pages: Iterator[Any] | None = None

        def page() -> Any:
            nonlocal pages
            try:
                if pages is None:
                    pages = iter(obstore.list(self._store, prefix, offset=last))
                return next(pages, None)
            except _FAILURES:
                pages = None  # a failed stream cannot continue: list again after the last key
                raise

        while (entries := self._try(prefix, page)) is not None:
            for entry in entries:
                last = str(entry["path"])
                yield StoredFile(last, int(entry["size"]), entry["last_modified"].timestamp())

    def delete(self, keys: Iterable[str]) -> None:
        left = iter(keys)
        while some := list(islice(left, _DELETED_AT_ONCE)):
            self._found(some[0], lambda some=some: obstore.delete(self._store, some))

    def _sending(self, size: int) -> Any:
        """The client for requests with N bytes: while it sends them, it takes the store for silent."""
        timeouts = 1 << int(size / (_SLOW_LINE * self._timeout_s)).bit_length()
        if timeouts not in self._stores:
            self._stores[timeouts] = self._open(self.prefix, timeouts)
        return self._stores[timeouts]

    def _open(self, prefix: str, timeouts: int) -> Any:
        timeout = timedelta(seconds=self._timeout_s)
        options: Any = {
            **connection_settings(),
            "connect_timeout": min(timeout, timedelta(seconds=5)),
            "read_timeout": timeouts * timeout,
            "timeout": max(10, timeouts) * timeout,  # for a whole object over a slow line
        }
        retries: Any = {"max_retries": 0, "retry_timeout": timeout}
        try:
            return S3Store(self.bucket, prefix=prefix or None, client_options=options, retry_config=retries)
        except _FAILURES as e:
            problem = "the AWS_* environment variables cannot be used"
            raise InputError(self.url, "", problem, "Check their spelling and values") from e

    def _found(self, key: str, request: Callable[[], Result]) -> Result | None:
        """Run a request with retries; None for a missing object."""
        try:
            return self._try(key, request)
        except FileNotFoundError:
            return None

    def _try(self, key: str, request: Callable[[], Result]) -> Result:
        """Run a request with retries; FileNotFoundError for a missing object."""
        start_s, pause_s, tries = time.monotonic(), _FIRST_PAUSE_S, 0
        while True:
            try:
                return request()
            except InputError:
                raise
            except _FAILURES as e:
                trouble = e.trouble if isinstance(e, _TransientTrouble) else store_trouble(e)
                if isinstance(e, FileNotFoundError) and trouble.problem != "no such bucket":
                    raise
                tries += 1
                error = trouble.at(f"{self.url}/{key}" if key else self.url)
                end_s = start_s + max(PATIENCE * self._timeout_s, waits_s())
                is_last = tries > 1 and time.monotonic() + pause_s > end_s
                if not trouble.is_transient or is_last or time.monotonic() > last_repetition_s():
                    raise error from e
                if tries == _TOLD_AFTER:
                    tell_repetition(error)
            time.sleep(pause_s * random.uniform(0.5, 1.0))
            pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)


class _TransientTrouble(OSError):
    """A failure that the client does not report as one."""

    def __init__(self, problem: str) -> None:
        self.trouble = RequestFailure(problem, "Submit again when the store has recovered", is_transient=True)
        super().__init__(problem)

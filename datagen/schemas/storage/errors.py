"""One-line errors with a fix for files and objects that cannot be read or written."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from datagen.schemas.errors import InputError

# Errors of the machine that any write can cause, whatever the shard.
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
FORBIDDEN = (errno.EROFS, errno.EACCES, errno.EPERM)
# The name exists, or its folder is a file.
TAKEN = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR)
MACHINE = (*FULL, *FORBIDDEN, errno.EMFILE, errno.ENAMETOOLONG)

_FIXES = {
    errno.ENOSPC: "Free disk space or write to another disk",
    errno.EDQUOT: "Free disk space or raise the quota",
    errno.EFBIG: "Raise the limit of file sizes (ulimit -f), or write to another file system",
    errno.EACCES: "Give yourself read and write permission there, or choose another folder",
    errno.EPERM: "Choose a folder on a file system that allows this (hard links, permissions)",
    errno.EROFS: "Choose a folder that can be written",
    errno.ENOTDIR: "A file is where a folder is needed: remove it or choose another folder",
    errno.EISDIR: "A folder is where a file is needed: remove it or choose another folder",
    errno.ENAMETOOLONG: "Choose a shorter path",
    errno.EMFILE: "Raise the limit of open files (ulimit -n)",
    errno.EIO: "Check the disk",
}
_OTHER_FIX = "Check that the path exists, is reachable and can be written"

_RESUME = "then continue with `datagen resume`"
_KEYS_FIX = "Check AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, and what they allow in this bucket"
_FULL_FIX = f"Free space in the store or raise its quota, {_RESUME}"
_REGION_FIX = "Set AWS_REGION to the bucket's region, or AWS_ENDPOINT_URL to its store"
_LOCK_FIX = "Set AWS_CHECKSUM_ALGORITHM=SHA256, or name a bucket without default retention"
_NEW_KEYS = f"Set new AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and AWS_SESSION_TOKEN, {_RESUME}"
_ALLOW = "Allow AWS_ACCESS_KEY_ID to get, put, delete and list in this bucket; see also its retention"
# Codes of servers, problem and fix.
_KNOWN = (
    ("NoSuchBucket", "no such bucket", "Create the bucket, or check its name and AWS_ENDPOINT_URL"),
    ("ExpiredToken ExpiredTokenException TokenRefreshRequired", "the credentials have expired", _NEW_KEYS),
    ("InvalidAccessKeyId", "access denied", "Check AWS_ACCESS_KEY_ID: the store does not know it"),
    ("SignatureDoesNotMatch", "access denied", "Check AWS_SECRET_ACCESS_KEY: it is not that of the key's id"),
    ("AccessDenied", "access denied", _ALLOW),
    ("RequestTimeTooSkewed RequestExpired", "this machine's clock differs from the store's", "Set the clock"),
    ("AuthorizationHeaderMalformed PermanentRedirect", "the bucket is in another region", _REGION_FIX),
    ("IllegalLocationConstraintException InvalidRegion", "the bucket is in another region", _REGION_FIX),
    ("QuotaExceeded XMinioAdminBucketQuotaExceeded", "the store is full", _FULL_FIX),
    ("XMinioStorageFull InsufficientStorage", "the store is full", _FULL_FIX),
)
_ADVICE = {code: (problem, fix) for codes, problem, fix in _KNOWN for code in codes.split()}
_ENDPOINT_FIX = f"Check AWS_ENDPOINT_URL and the network, {_RESUME}"
_TRUSTED = r"[A-Za-z][A-Za-z0-9.]{0,60}"


class StoreUnavailable(InputError):
    """An object store that refuses or does not respond, after all retries.

    It concerns the whole job, not one shard: the job stops.
    """


class StoreRefuses(StoreUnavailable):
    """An object store that refuses a request: retries cannot succeed, another machine's might."""


class NotARegularFile(InputError):
    """A link, a pipe, a socket or a device, or folders that are nested too deeply."""


class FileTooLarge(InputError):
    """A file that is too large to read."""


@dataclass(frozen=True)
class RequestFailure:
    """The failure of one request to an object store; `is_transient` where a retry may succeed."""

    problem: str
    fix: str
    is_transient: bool

    def at(self, place: str) -> StoreUnavailable:
        kind = StoreUnavailable if self.is_transient else StoreRefuses
        return kind(place, "", self.problem, self.fix)


JOBS_WAIT_S = 300.0  # for which a job repeats a request that its store fails
_told: list[Callable[[StoreUnavailable], None]] = []


@contextmanager
def repeated_for_minutes(told: Callable[[StoreUnavailable], None] = lambda error: None) -> Generator[None]:
    """Within the block, requests that a store fails are repeated for `JOBS_WAIT_S`.

    `told` is called, by any thread, with the error of a request that fails for some seconds.
    """
    _told.append(told)
    try:
        yield
    finally:
        _told.remove(told)


_last_s: list[Callable[[], float]] = []


@contextmanager
def repeated_until(end_s: Callable[[], float]) -> Generator[None]:
    """Within the block, no request is repeated after `end_s()` by the monotonic clock, in any thread."""
    _last_s.append(end_s)
    try:
        yield
    finally:
        _last_s.remove(end_s)


def last_repetition_s() -> float:
    """When this process repeats no request any more, by the monotonic clock."""
    return min((end_s() for end_s in _last_s), default=float("inf"))


def tell_repetition(error: StoreUnavailable) -> None:
    """Report a request that fails for some seconds, and is repeated."""
    for told in list(_told):
        told(error)


def waits_s() -> float:
    """Seconds for which this process repeats requests at least."""
    return JOBS_WAIT_S if _told else 0.0


def storage_error(place: str | Path, error: OSError) -> InputError:
    """The one-line error for a failed file operation, with the fix for its errno."""
    problem = os.strerror(error.errno) if error.errno is not None else str(error)
    return InputError(place, "", problem, _FIXES.get(error.errno or 0, _OTHER_FIX))


def machine_error(error: BaseException | None, codes: Sequence[int] = MACHINE) -> InputError | None:
    """The one-line error where an exception has one of `codes`; else None."""
    known = error if isinstance(error, InputError) else None
    while error is not None:
        if isinstance(error, OSError) and error.errno in codes:
            return known or storage_error(error.filename or error.filename2 or "a file", error)
        error = error.__cause__ or error.__context__
    return None


def too_large(place: str, size: int, limit_bytes: int) -> FileTooLarge:
    """The error for a file above the limit."""
    problem = f"has {size} bytes, more than the {limit_bytes} that such a file can have"
    fix = "It was not written by datagen: restore the run from a copy, or remove the file"
    return FileTooLarge(place, "", problem, fix)


def store_trouble(error: Exception) -> RequestFailure:
    """Translate an exception of the object store's client.

    Only the status, the server's error code and the kind of failure are reported: addresses and headers in
    the text may contain credentials.
    """
    text = str(error)
    status = _found(r"non-2xx status code: ([0-9]{3})", text) or _found(r"status: ([0-9]{3})", text)
    code = _found(rf"<Code>({_TRUSTED})</Code>", text)
    if "//169.254." in text:  # address at which a cloud machine requests its role
        is_busy = status.startswith("5") or status == "429"
        return RequestFailure("no credentials are set", _KEYS_FIX, is_transient=is_busy)
    if known := _ADVICE.get(code):
        problem = known[0] if code == "NoSuchBucket" else f"{known[0]} ({code})"
        return RequestFailure(problem, known[1], is_transient=False)
    if re.search("(?i)<Message>[^<]*Content-MD5", text):  # no store has a code of its own for it
        return RequestFailure("the bucket requires checksums (object lock)", _LOCK_FIX, is_transient=False)
    if "Received redirect without LOCATION" in text or status in ("301", "307"):
        return RequestFailure("the bucket is in another region", _REGION_FIX, is_transient=False)
    if status in ("401", "403"):
        return RequestFailure(f"access denied ({code or status})", _KEYS_FIX, is_transient=False)
    if status and not status.startswith("2"):
        shown = f"{status} {code}" if code else status
        if (status.startswith("5") and status not in ("501", "507")) or status in ("408", "409", "429"):
            fix = f"Wait until the store has recovered, {_RESUME}"
            return RequestFailure(f"the store responds {shown}", fix, is_transient=True)
        fix = "Check that AWS_ENDPOINT_URL is an S3 store that supports this request"
        return RequestFailure(f"the store refuses ({shown})", fix, is_transient=False)
    return _connection_failure(text)


def _connection_failure(text: str) -> RequestFailure:
    kind = _found(r"HttpError \{\s*kind: ([A-Za-z]+)", text)
    if kind == "Connect":
        why = "unknown host name" if "dns error" in text else "the connection fails"
        return RequestFailure(f"the store cannot be reached ({why})", _ENDPOINT_FIX, is_transient=True)
    if kind == "Timeout":
        fix = f"Check the network, or raise DATAGEN_STORE_TIMEOUT_S, {_RESUME}"
        return RequestFailure("the store does not respond in time", fix, is_transient=True)
    if kind in ("Request", "Interrupted", "Decode"):
        return RequestFailure("the store's response is cut off", _ENDPOINT_FIX, is_transient=True)
    fix = "Check that AWS_ENDPOINT_URL is an S3 store"
    return RequestFailure("the response is not that of an S3 store", fix, is_transient=False)


def _found(pattern: str, text: str) -> str:
    found = re.search(pattern, text)
    return found[1] if found else ""

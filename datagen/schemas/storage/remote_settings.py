"""Settings of an object store from its s3:// address and the environment, checked before use."""

from __future__ import annotations

import os
import re
from urllib.parse import urlsplit

from datagen.schemas.errors import InputError

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

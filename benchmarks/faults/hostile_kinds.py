"""Kinds of hostile files, which `hostile_files` puts in place of each file."""

from __future__ import annotations

import gzip
import io
import os
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path


def _packed(block: bytes, blocks: int) -> bytes:
    """Gzip members that follow each other unpack to one stream."""
    return gzip.compress(block, 9) * blocks


HOUSE_FILES: dict[str, Callable[[], bytes]] = {
    "30 million lines": lambda: _packed(b"{}\n" * 1_000_000, 30),
    "400 MB of newlines": lambda: _packed(b"\n" * 10_000_000, 40),
    "4 GB in one line": lambda: _packed(b"a" * 10_000_000, 400),
    "4 GB of spaces": lambda: _packed((b" " * 999_999 + b"\n") * 10, 400),
    "deep lists": lambda: _packed(b"[" * 10_000_000 + b"\n", 1),
    "deep objects": lambda: _packed(b'{"a":' * 2_000_000 + b"\n", 1),
    "wide lists": lambda: _packed(b"[" + b"{}," * 5_000_000 + b"{}]\n", 1),
    "a cut file": lambda: gzip.compress(b"{}\n" * 1000)[:-9],
    "no gzip": lambda: b"{}\n" * 1000,
}

TEXTS = {
    "a lone surrogate": "\ud800",
    "a NUL": "a\0b",
    "an escape": "\x1b]52;c;aGk=\x07",
    "a line break": "a\nb",
    "text that runs backwards": "\u202ea",
}


def _link(target: str) -> Callable[[Path], None]:
    return lambda path: path.symlink_to(target)


def _pipe_behind_a_link(path: Path) -> None:
    os.mkfifo(path.with_name(f".{path.name}.pipe"))
    path.symlink_to(path.with_name(f".{path.name}.pipe"))


ODD_FILES: dict[str, Callable[[Path], None]] = {
    "pipe": os.mkfifo,
    "link to a pipe": _pipe_behind_a_link,
    "link to a device": _link("/dev/zero"),
    "link to nothing": _link("/nothing/here"),
    "folder": os.mkdir,
}


def _text(text: str) -> Callable[[Path], None]:
    def put(path: Path) -> None:
        path.write_text(text)

    return put


TOML_FILES: dict[str, Callable[[Path], None]] = {
    "deep lists": _text("a = " + "[" * 50_000 + "]" * 50_000),
    "deep keys": _text("a." * 50_000 + "a = 1"),
    "deep tables": _text("[" + "scene." * 50_000 + "a]"),
    "deep inline tables": _text("a = " + "{a = " * 50_000 + "1" + "}" * 50_000),
    "an escape in a key": _text('"\\u001b[31m\\u202e" = 1'),
    "a long number": _text("seed = " + "1" * 100_000),
    "2 MB": _text("#" * 2_000_000),
}

_Member = tuple[str, bytes, bytes, str]  # name, content, type, target of a link


def _tar(*members: _Member) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as tar:
        for name, content, kind, target in members:
            info = tarfile.TarInfo(name)
            info.size, info.type, info.linkname = len(content), kind, target
            tar.addfile(info, io.BytesIO(content))
    return buffer.getvalue()


def _zip(*members: tuple[str, bytes], mode: int = 0o100644) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, content in members:
            info = zipfile.ZipInfo(name)
            info.external_attr, info.compress_type = mode << 16, zipfile.ZIP_DEFLATED
            packed.writestr(info, content)
    return buffer.getvalue()


def _tar_claiming(size: int) -> bytes:
    info = tarfile.TarInfo("huge")
    info.size = size
    return info.tobuf(tarfile.GNU_FORMAT)


def _long_names(count: int) -> bytes:
    info = tarfile.TarInfo("././@LongLink")
    info.type, info.size = tarfile.GNUTYPE_LONGNAME, 512
    return (info.tobuf(tarfile.GNU_FORMAT) + b"a" * 511 + b"\0") * count


_FILE = tarfile.REGTYPE
ARCHIVES: dict[str, Callable[[], bytes]] = {
    "tar, parent": lambda: _tar(("../../out.txt", b"x", _FILE, "")),
    "tar, absolute": lambda: _tar(("/tmp/datagen-hostile-out.txt", b"x", _FILE, "")),
    "tar, symbolic link": lambda: _tar(("a", b"", tarfile.SYMTYPE, "/etc"), ("a/x", b"x", _FILE, "")),
    "tar, hard link": lambda: _tar(("a", b"", tarfile.LNKTYPE, "/etc/passwd")),
    "tar, device": lambda: _tar(("a", b"", tarfile.CHRTYPE, "")),
    "tar, pipe": lambda: _tar(("a", b"", tarfile.FIFOTYPE, "")),
    "tar, twice": lambda: _tar(("a", b"x", _FILE, ""), ("A", b"y", _FILE, "")),
    "tar, escape in a name": lambda: _tar(("a\x1b[31m", b"x", _FILE, "")),
    "tar, a file of 8 GB": lambda: gzip.compress(_tar_claiming(8 * 10**9)),
    "tar, names of names": lambda: _long_names(5000),
    "zip, parent": lambda: _zip(("../../out.txt", b"x")),
    "zip, symbolic link": lambda: _zip(("a", b"/etc"), mode=0o120777),
    "zip, device": lambda: _zip(("a", b""), mode=0o020666),
    "zip, twice": lambda: _zip(("a", b"x"), ("A", b"y")),
    "zip, bomb": lambda: _zip(*[(f"{k}", bytes(30_000_000)) for k in range(40)]),
    "zip, list of 100 MB": lambda: bytes(4) + b"PK\1\2" + bytes(10**8) + _zip_end(10**8 + 4),
    "no archive": lambda: b"x" * 1000,
}


def _zip_end(size: int) -> bytes:
    """The end of a zip that states a list of members of this size."""
    return b"PK\5\6" + bytes(4) + b"\1\0\1\0" + size.to_bytes(4, "little") + bytes(4) + bytes(2)

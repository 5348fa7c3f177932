"""Archives that try to get out or grow without end, and locks that lie."""

from __future__ import annotations

import gzip
import io
import json
import stat
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from datagen.assets.lock import LOCK_NAME, lock, read_lock, verify
from datagen.assets.unpack import Limits, unpack
from datagen.schemas.errors import InputError

LIMITS = Limits(total_bytes=100_000, files=20)


def _tar(*members: tuple[str, bytes, bytes, str], packed: bool = True) -> bytes:
    """(name, data, type, link target) each."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz" if packed else "w") as tar:
        for name, data, kind, link in members:
            info = tarfile.TarInfo(name)
            info.size, info.type, info.linkname = len(data), kind, link
            tar.addfile(info, io.BytesIO(data))
    return out.getvalue()


def _plain(name: str, data: bytes = b"x") -> tuple[str, bytes, bytes, str]:
    return name, data, tarfile.REGTYPE, ""


def _zip(name: str, data: bytes = b"x", mode: int = 0o100644, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as packed:
        info = zipfile.ZipInfo(name)
        info.external_attr = mode << 16
        packed.writestr(info, data, method)
    return out.getvalue()


def _lying_header() -> bytes:
    """A pax header that claims terabytes, in few bytes."""
    info = tarfile.TarInfo("pax")
    info.type, info.size = tarfile.XHDTYPE, 2**40
    return gzip.compress(info.tobuf(tarfile.GNU_FORMAT) + bytes(2048))


HOSTILE: dict[str, Callable[[], bytes]] = {
    "tar, parent": lambda: _tar(_plain("../out.txt")),
    "tar, parent inside": lambda: _tar(_plain("a/../../out.txt")),
    "tar, absolute": lambda: _tar(_plain("/tmp/out.txt")),
    "tar, backslash": lambda: _tar(_plain("..\\out.txt")),
    "tar, drive": lambda: _tar(_plain("C:/out.txt")),
    "tar, symbolic link": lambda: _tar(("a", b"", tarfile.SYMTYPE, "/etc"), _plain("a/out.txt")),
    "tar, hard link": lambda: _tar(("a", b"", tarfile.LNKTYPE, "/etc/hostname")),
    "tar, device": lambda: _tar(("a", b"", tarfile.CHRTYPE, "")),
    "tar, pipe": lambda: _tar(("a", b"", tarfile.FIFOTYPE, "")),
    "tar, folder outside": lambda: _tar(("../a", b"", tarfile.DIRTYPE, "")),
    "tar, too much": lambda: _tar(_plain("a", bytes(60_000)), _plain("b", bytes(60_000))),
    "tar, too many": lambda: _tar(*[_plain(f"f{i}") for i in range(21)]),
    "tar, twice": lambda: _tar(_plain("a"), _plain("A")),
    "tar, lying header": _lying_header,
    "tar, cut off": lambda: _tar(_plain("a", b"q" * 5000), packed=False)[:3000],
    "tar, not packed right": lambda: _tar(_plain("a", bytes(range(256)) * 200))[:-60],
    "zip, parent": lambda: _zip("../out.txt"),
    "zip, absolute": lambda: _zip("/tmp/out.txt"),
    "zip, symbolic link": lambda: _zip("a", b"/etc", stat.S_IFLNK | 0o777),
    "zip, device": lambda: _zip("a", b"", stat.S_IFBLK | 0o600),
    "zip, bomb": lambda: _zip("a", bytes(10**6)),
    "zip, bad checksum": lambda: _zip("a", b"hello").replace(b"\xcbH\xcd\xc9\xc9", b"\xcbH\xcd\xc9\xc8"),
    "zip, bzip2": lambda: _zip("a", method=zipfile.ZIP_BZIP2),
    "zip, LZMA": lambda: _zip("a", method=zipfile.ZIP_LZMA),
    "no archive": lambda: b"hello world" * 100,
    "empty file": lambda: b"",
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_archives_are_refused_and_leave_nothing(case: str, tmp_path: Path) -> None:
    archive, folder = tmp_path / "archive.bin", tmp_path / "in" / "folder"
    archive.write_bytes(HOSTILE[case]())
    with pytest.raises(InputError) as caught:
        unpack(archive, folder, LIMITS)
    assert str(archive) in str(caught.value)
    assert list(folder.iterdir()) == []
    assert sorted(p.name for p in tmp_path.iterdir()) == ["archive.bin", "in"]


def test_no_changed_byte_of_a_zip_gives_more_than_a_line(tmp_path: Path) -> None:
    good, archive = _zip("a", b"hello" * 9), tmp_path / "archive.bin"
    for at in range(len(good)):
        for bit in (0x01, 0x80):
            archive.write_bytes(good[:at] + bytes([good[at] ^ bit]) + good[at + 1 :])
            try:
                unpack(archive, tmp_path / "folder", LIMITS)
            except InputError as error:
                assert error.place == str(archive)


@pytest.mark.parametrize("packed", [True, False])
def test_good_tars_unpack(packed: bool, tmp_path: Path) -> None:
    (tmp_path / "t").write_bytes(
        _tar(("d", b"", tarfile.DIRTYPE, ""), _plain("d/a.txt", b"A"), _plain("b.txt", b"B"), packed=packed)
    )
    (tmp_path / "out").mkdir()
    (tmp_path / "out/b.txt").write_text("old")
    assert [str(p) for p in unpack(tmp_path / "t", tmp_path / "out", LIMITS)] == ["b.txt", "d/a.txt"]
    assert (tmp_path / "out/d/a.txt").read_bytes() == b"A"
    assert (tmp_path / "out/b.txt").read_bytes() == b"B"


def test_a_link_in_the_folder_carries_nothing_out(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out/d").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "t").write_bytes(_tar(_plain("d/a.txt")))
    with pytest.raises(InputError, match="link"):
        unpack(tmp_path / "t", tmp_path / "out", LIMITS)
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_lock_and_verify_see_every_change(tmp_path: Path) -> None:
    for name, text in (("a.txt", "A"), ("d/b.txt", "B"), ("d/c.txt", "C")):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    written = lock(tmp_path, licence="CC0-1.0", source="here")
    assert [entry.path for entry in written.files] == ["a.txt", "d/b.txt", "d/c.txt"]
    assert read_lock(tmp_path) == written
    assert verify(tmp_path).good
    (tmp_path / "a.txt").write_text("X")
    (tmp_path / "d/b.txt").unlink()
    (tmp_path / "new.txt").write_text("N")
    result = verify(tmp_path)
    assert (result.changed, result.missing, result.unlisted) == (("a.txt",), ("d/b.txt",), ("new.txt",))
    assert not result.good
    again = lock(tmp_path)
    assert {entry.path: entry.licence for entry in again.files} == {
        "a.txt": "CC0-1.0", "d/c.txt": "CC0-1.0", "new.txt": "unknown",
    }  # fmt: skip


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        json.dumps({"version": 2}),
        json.dumps({"version": 1, "surprise": 1}),
        json.dumps({"version": 1, "files": [{"path": "a", "sha256": "0", "size": 1}]}),
        json.dumps({"version": 1, "files": [{"path": "a", "sha256": "0" * 64, "size": -1}]}),
        json.dumps({"version": 1, "files": [{"path": "../a", "sha256": "0" * 64, "size": 1}]}),
        json.dumps({"version": 1, "files": [{"path": "/etc/hostname", "sha256": "0" * 64, "size": 1}]}),
    ],
)
def test_broken_locks_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / LOCK_NAME).write_text(text)
    with pytest.raises(InputError) as caught:
        verify(tmp_path)
    assert LOCK_NAME in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_lock_and_nothing_to_lock(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        verify(tmp_path)
    with pytest.raises(InputError, match="no files"):
        lock(tmp_path)

"""Archives that try to get out, or grow without end by their members, lists or headers."""

from __future__ import annotations

import gzip
import io
import stat
import struct
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

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


def long_list() -> bytes:
    """A zip whose end states a list of members of 100 MB."""
    return (
        b"PK\x01\x02"
        + bytes(100_000_000)
        + struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 9, 9, 100_000_004, 0, 0)
    )


def honest_bomb() -> bytes:
    """A zip of members that state that they are far beyond the limit together."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as packed:
        for number in range(20):
            packed.writestr(f"{number}", bytes(100_000))
    return buffer.getvalue()


def nested_headers() -> bytes:
    """A tar of long names that are each the name of another long name."""
    info = tarfile.TarInfo("././@LongLink")
    info.type, info.size = tarfile.GNUTYPE_LONGNAME, 512
    return (info.tobuf(tarfile.GNU_FORMAT) + b"a" * 511 + b"\0") * 5000


@pytest.mark.parametrize(
    ("make", "said"),
    [(long_list, "too large"), (honest_bomb, "2,000,000 bytes"), (nested_headers, "damaged")],
)
def test_a_bomb_in_the_description_is_refused(make: Callable[[], bytes], said: str, tmp_path: Path) -> None:
    (tmp_path / "archive").write_bytes(make())
    with pytest.raises(InputError, match=said):
        unpack(tmp_path / "archive", tmp_path / "out", Limits(1_000_000))
    assert list((tmp_path / "out").iterdir()) == []

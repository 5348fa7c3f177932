"""Archives that are damaged, or have names and links that lead out of the folder."""

from __future__ import annotations

import io
import stat
import tarfile
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from datagen.assets.fetch import unpack
from datagen.schemas.errors import InputError


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


OUTSIDE: dict[str, Callable[[], bytes]] = {
    "tar, parent": lambda: _tar(_plain("../out.txt")),
    "tar, parent inside": lambda: _tar(_plain("a/../../out.txt")),
    "tar, absolute": lambda: _tar(_plain("/../out.txt")),
    "tar, symbolic link": lambda: _tar(("a", b"", tarfile.SYMTYPE, "../.."), _plain("a/out.txt")),
    "tar, hard link": lambda: _tar(("a", b"", tarfile.LNKTYPE, "/etc/hostname")),
    "tar, device": lambda: _tar(("a", b"", tarfile.CHRTYPE, "")),
    "tar, folder outside": lambda: _tar(("../a", b"", tarfile.DIRTYPE, "")),
    "zip, parent": lambda: _zip("../out.txt"),
    "zip, absolute": lambda: _zip("/../out.txt"),
    "zip, symbolic link": lambda: _zip("a", b"/etc", stat.S_IFLNK | 0o777),
}
DAMAGED: dict[str, Callable[[], bytes]] = {
    "tar, cut off": lambda: _tar(_plain("a", b"q" * 5000), packed=False)[:3000],
    "tar, not packed right": lambda: _tar(_plain("a", bytes(range(256)) * 200))[:-60],
    "zip, bad checksum": lambda: _zip("a", b"hello").replace(b"\xcbH\xcd\xc9\xc9", b"\xcbH\xcd\xc9\xc8"),
    "no archive": lambda: b"hello world" * 100,
    "empty file": lambda: b"",
    "tar, links alone": lambda: _tar(("a", b"", tarfile.SYMTYPE, "b")),
}


@pytest.mark.parametrize("case", OUTSIDE)
def test_no_archive_reaches_out_of_the_folder(case: str, tmp_path: Path) -> None:
    archive, folder = tmp_path / "archive.bin", tmp_path / "in" / "folder"
    archive.write_bytes(OUTSIDE[case]())
    with suppress(InputError):
        unpack(archive, folder)
    assert {"in"} <= {p.name for p in tmp_path.iterdir()} <= {"archive.bin", "in"}
    assert [p.name for p in folder.parent.iterdir()] == ["folder"]
    assert not any(p.is_symlink() or not (p.is_file() or p.is_dir()) for p in folder.rglob("*"))


@pytest.mark.parametrize("case", DAMAGED)
def test_damaged_archives_are_refused_and_leave_nothing(case: str, tmp_path: Path) -> None:
    archive, folder = tmp_path / "archive.bin", tmp_path / "folder"
    archive.write_bytes(DAMAGED[case]())
    with pytest.raises(InputError) as caught:
        unpack(archive, folder)
    assert str(archive) in str(caught.value) and list(folder.iterdir()) == []
    assert not archive.exists()


@pytest.mark.parametrize("packed", [True, False])
def test_good_tars_unpack(packed: bool, tmp_path: Path) -> None:
    (tmp_path / "t").write_bytes(
        _tar(("d", b"", tarfile.DIRTYPE, ""), _plain("d/a.txt", b"A"), _plain("b.txt", b"B"), packed=packed)
    )
    (tmp_path / "out").mkdir()
    (tmp_path / "out/b.txt").write_text("old")
    assert unpack(tmp_path / "t", tmp_path / "out") == 2
    assert (tmp_path / "out/d/a.txt").read_bytes() == b"A"
    assert (tmp_path / "out/b.txt").read_bytes() == b"B"

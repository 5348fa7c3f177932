"""Files that anybody may name: only regular ones of a bounded size are opened, and nothing waits."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from datagen.schemas.errors import InputError
from datagen.schemas.safe_files import open_regular, read_regular


def test_a_regular_file_is_read_up_to_its_bound(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    (tmp_path / "link").symlink_to(path)
    assert read_regular(path, 5, "fix") == read_regular(tmp_path / "link", 5, "fix") == b"12345"
    with open_regular(path, 5, "fix") as file:
        assert not os.get_inheritable(file.fileno())
    with pytest.raises(InputError, match="5 bytes, more than the 4 allowed"):
        read_regular(path, 4, "fix")


@pytest.mark.parametrize("kind", ["pipe", "socket", "folder", "link", "/dev/zero", "/dev/stdin"])
def test_what_is_no_regular_file_is_refused_and_waited_for_by_nothing(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "here"
    with socket.socket(socket.AF_UNIX) as listening:
        os.mkfifo(tmp_path / "pipe")
        make = {"socket": lambda: listening.bind(str(path)), "folder": path.mkdir}
        make |= {"link": lambda: path.symlink_to("pipe")}
        path = make[kind]() or path if kind in make else tmp_path / kind
        before = len(list(Path("/proc/self/fd").iterdir()))
        with pytest.raises(InputError, match="is not a file") as refused:
            open_regular(path, 100, "Give a file")
    assert str(path) in str(refused.value) and len(list(Path("/proc/self/fd").iterdir())) <= before


@pytest.mark.parametrize("name", ["gone", "a\0b", "\ud800", "x" * 5000, "file/below"])
def test_a_name_of_nothing_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"cannot be read|is not a file"):
        open_regular(tmp_path / name, 100, "Give a file")


@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="needs Linux's /proc")
def test_a_file_that_hides_its_size_is_bounded_while_it_is_read() -> None:
    with pytest.raises(InputError, match="more than 10 bytes"):
        read_regular(Path("/proc/self/status"), 10, "fix")

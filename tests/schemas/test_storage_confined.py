"""Links, pipes and devices of others: none is followed, opened, waited for or listed through."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from datagen.schemas.errors import InputError
from datagen.schemas.record_files import refuse_foreign
from datagen.schemas.safe_files import open_regular, read_regular
from datagen.schemas.storage import Storage, open_storage
from tests.made_runs import files_of

VERBS: dict[str, Callable[[Storage, str], object]] = {
    "get": lambda s, key: s.get(key, 10**6),
    "get_many": lambda s, key: list(s.get_many([key], 10**6)),
    "exists": lambda s, key: s.exists(key),
    "get_range": lambda s, key: s.get_range(key, -9, 9),
    "put_new": lambda s, key: s.put_new(key, b"x"),
    "below": lambda s, key: s.below(key).get("x", 9),
}


@pytest.fixture
def place(tmp_path: Path) -> Storage:
    """A storage beside a folder of secrets."""
    (tmp_path / "secrets").mkdir()
    (tmp_path / "secrets" / "key").write_text("secret")
    return open_storage(tmp_path / "run")


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as s:
        s.bind(str(path))


def _device(path: Path) -> None:
    try:
        os.mknod(path, 0o600 | 0o020000, os.makedev(1, 5))
    except PermissionError:
        pytest.skip("devices cannot be made here")


KINDS: dict[str, Callable[[Path], None]] = {
    "pipe": os.mkfifo,
    "socket": _socket,
    "device": _device,
    "link to a file": lambda path: path.symlink_to("../../secrets/key"),
    "link to a folder": lambda path: path.symlink_to("../../secrets"),
    "link within": lambda path: path.symlink_to("plain"),
    "dangling link": lambda path: path.symlink_to("/nowhere/at/all"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_plain_file_is_refused_by_name(kind: str, place: Storage):
    assert place.folder is not None
    secrets = place.folder.parent / "secrets"
    place.put("a/plain", b"x")
    KINDS[kind](place.folder / "a" / "odd")
    for name, verb in VERBS.items():
        with pytest.raises(InputError, match=r"which a run never has\. Remove it") as e:
            verb(place, "a/odd")
        assert f"{place.url}/a/odd" in str(e.value), name
    for prefix in ("", "a"):
        with pytest.raises(InputError, match="a/odd: is a"):
            list(place.list(prefix))
    place.put("a/odd", b"ours")  # a name is replaced, whatever stood there
    assert place.get("a/odd", 9) == b"ours"
    assert files_of(secrets) == {"key": b"secret"}


def test_no_verb_goes_through_a_link_in_a_path(place: Storage):
    assert place.folder is not None
    secrets = place.folder.parent / "secrets"
    (place.folder / "shards").symlink_to(secrets)
    for verb in (
        *(lambda v=v: v(place, "shards/key") for v in VERBS.values()),
        lambda: place.put("shards/key", b"overwritten"),
        lambda: place.put("shards/deep/er", b"new"),
        lambda: place.delete(["shards/key"]),
        lambda: list(place.list("shards")),
        lambda: place.below("shards").put("key", b"overwritten"),
        lambda: list(place.below("shards").list("")),
    ):
        with pytest.raises(
            InputError, match="'shards' in this path is a symbolic link, which a run never has"
        ):
            verb()
    place.delete(["shards"])  # the link itself
    assert files_of(secrets) == {"key": b"secret"}
    assert not (place.folder / "shards").exists()


def test_the_root_may_be_a_link_and_a_link_in_a_foreign_folder_is_left(tmp_path: Path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "run").symlink_to(tmp_path / "disk")
    s = open_storage(tmp_path / "run")
    assert s.put_new("shards/b", b"x") and s.get("shards/b", 9) == b"x"
    assert files_of(tmp_path / "disk") == {"shards/b": b"x"}
    (tmp_path / "disk" / "link").symlink_to(tmp_path)
    with pytest.raises(InputError, match=r"link: holds other files than those of a run\. Choose a new"):
        refuse_foreign(s)


def test_folders_without_end_are_refused(place: Storage):
    assert place.folder is not None
    (place.folder / "/".join(["d"] * 40)).mkdir(parents=True)
    with pytest.raises(InputError, match="folders are nested too deeply"):
        list(place.list(""))


def test_a_folder_is_no_file(place: Storage):
    place.put("a/b", b"x")
    assert not place.exists("a")
    for verb in (lambda: place.get("a", 9), lambda: place.put("a", b""), lambda: place.delete(["a"])):
        with pytest.raises(InputError, match="A folder is where a file is needed"):
            verb()
    with pytest.raises(InputError, match="A file is where a folder is needed"):
        place.get("a/b/c", 9)


ABSOLUTE, ODD = ("", "/", "/etc/passwd"), ("..", "../x", "a/../b", "a/..", "./a", "a/./b", "a//b", "a/")


@pytest.mark.parametrize("key", [*ABSOLUTE, *ODD, "a\0b", "a\nb", "a\\b"])
def test_keys_that_lead_elsewhere_are_refused(key: str, place: Storage):
    for verb in (*VERBS.values(), lambda s, k: s.put(k, b""), lambda s, k: s.delete([k])):
        with pytest.raises(InputError, match="not the name of a file below the root"):
            verb(place, key)
    for good in ("a.b", "é ü", "-", "...", "a/.b/..c"):
        place.put(good, b"x")
        place.delete([good])
    assert files_of(place.folder.parent) == {"secrets/key": b"secret"}  # type: ignore[union-attr]


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

"""What a power cut would take: every write is followed up to the fsync that makes it last."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from datagen.schemas.merging import merge_runs, plan_merge
from datagen.schemas.sealing import seal
from datagen.schemas.storage import open_storage
from tests.made_runs import attempt, make_run, write


class Disk:
    """Which bytes and which names were written since the fsync of their file, or of their folder.

    Names that go are not followed: a draft that comes back after a power cut is garbage.
    """

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.bytes: set[int] = set()  # inodes of files
        self.names: set[tuple[int, str]] = set()  # inodes of folders, and what is named in them
        self.named: Callable[[str], None] = lambda name: None  # hears of every name that is about to be given
        plain = {name: getattr(os, name) for name in ("write", "fsync", "link", "rename", "mkdir")}

        def write(fd: int, data: Any) -> int:
            self.bytes.add(os.fstat(fd).st_ino)
            return plain["write"](fd, data)

        def fsync(fd: int) -> None:
            plain["fsync"](fd)
            inode = os.fstat(fd).st_ino
            self.bytes.discard(inode)
            self.names -= {name for name in self.names if name[0] == inode}

        def naming(call: str, folder: str) -> Callable[..., None]:
            def name(*arguments: Any, **options: Any) -> None:
                at = arguments[0 if call == "mkdir" else 1]
                self.named(os.fspath(at))
                plain[call](*arguments, **options)
                fd = options.get(folder)
                inode = os.fstat(fd).st_ino if fd is not None else Path(at).parent.stat().st_ino
                self.names.add((inode, Path(at).name))

            return name

        for call, made in {"write": write, "fsync": fsync}.items():
            patch.setattr(os, call, made)
        for call, folder in {"link": "dst_dir_fd", "rename": "dst_dir_fd", "mkdir": "dir_fd"}.items():
            patch.setattr(os, call, naming(call, folder))

    def lost(self, place: Path) -> set[str]:
        """Files and folders below a place that a power cut would take, or empty."""
        found: set[str] = set()
        for path in sorted(place.rglob("*")):
            is_named = (path.parent.stat().st_ino, path.name) not in self.names
            if not is_named or path.stat().st_ino in self.bytes:
                found.add(str(path.relative_to(place)))
        return found

    def watched(self, place: Path, name: str) -> list[set[str]]:
        """What would be lost at each moment at which something gets this name."""
        found: list[set[str]] = []
        self.named = lambda given: found.append(self.lost(place)) if given == name else None
        return found


@pytest.fixture
def disk(few_arrays: None, monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(monkeypatch)


def test_a_new_name_is_given_to_bytes_that_last_and_lasts_itself(disk: Disk, tmp_path: Path) -> None:
    place = open_storage(tmp_path / "far" / "away")
    assert disk.lost(tmp_path) == set()
    lost = disk.watched(tmp_path, "new")
    place.put_new("a/b/new", b"bytes")
    assert lost == [{"far/away/a", "far/away/a/b"}] and disk.lost(tmp_path) == set()


def test_what_somebody_else_wrote_and_did_not_make_last_is_made_to(disk: Disk, tmp_path: Path) -> None:
    place = open_storage(tmp_path)
    place.put("a/b", b"bytes", durably=False)
    assert disk.lost(tmp_path) == {"a", "a/b"}
    assert place.put_new("a/b", b"bytes") and disk.lost(tmp_path) == set()
    place.put("a/c", b"bytes")
    assert disk.lost(tmp_path) == set()


def test_a_shard_is_committed_when_its_object_lasts(disk: Disk, tmp_path: Path) -> None:
    run = make_run(tmp_path, 20, shards=[])
    made = write(run, 0, "a-0")
    lost = disk.watched(tmp_path, "000000.json")
    assert run.commit(made)
    assert lost == [{"commits"}]
    assert attempt(run, 1, "a-1") and disk.lost(tmp_path) == set()


def test_a_store_counts_and_the_one_before_it_goes_when_it_lasts(disk: Disk, tmp_path: Path) -> None:
    for n in (20, 40):
        run = make_run(tmp_path, n)
        lost = disk.watched(tmp_path, "data.json")
        seal(run.storage)
        assert lost == [set()] and disk.lost(tmp_path) == set()
    assert (tmp_path / "data-2.zarr").exists() and not (tmp_path / "data.zarr").exists()


def test_merged_shards_are_committed_when_they_last(disk: Disk, tmp_path: Path) -> None:
    make_run(tmp_path / "a", 20)
    make_run(tmp_path / "b", 10, 1)
    planned = plan_merge([f"{tmp_path}/a", f"{tmp_path}/b"], f"{tmp_path}/out")
    lost = disk.watched(tmp_path / "out", "000000.json")
    merge_runs(planned)
    assert [{Path(path).name for path in each} for each in lost] == [{"commits"}] * 2
    assert disk.lost(tmp_path / "out") == set()

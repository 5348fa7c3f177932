"""A cache that saves time and decides nothing: damaged, blocked and shared by processes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from datagen.schemas.safe_files import whole_file
from datagen.workers.content_cache import Arrays, CacheFolder
from datagen.workers.houses import open_houses
from datagen.workers.objects import open_objects
from datagen.workers.world import World, assemble_world
from tests.made_runs import small_spec
from tests.other_user import as_another_user, needs_root
from tests.workers.objects.toy_set import write_bundle

THINGS = CacheFolder("things", most_files=3)
CONTENT: Arrays = {
    "points": np.arange(12, dtype=np.float32).reshape(4, 3),
    "name": np.array("cup"),
}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DATAGEN_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "things"


def is_content(found: Arrays | None) -> bool:
    return (
        found is not None
        and found.keys() == CONTENT.keys()
        and all(found[k].tobytes() == CONTENT[k].tobytes() for k in CONTENT)
    )


def test_a_damaged_file_is_read_whole_or_not_at_all(folder: Path) -> None:
    THINGS.store("key", CONTENT)
    path = folder / "key.npz"
    good = path.read_bytes()
    for length in range(0, len(good), 7):
        path.write_bytes(good[:length])
        assert THINGS.load("key") is None
    rng = np.random.default_rng(0)
    n_refused = 0
    for place in range(0, len(good), 2):
        bad = bytearray(good)
        bad[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(bad)
        found = THINGS.load("key")
        assert found is None or is_content(found)
        n_refused += found is None
    assert n_refused > len(good) / 4


def test_stored_arrays_are_loaded_and_the_file_of_another_key_is_not(folder: Path) -> None:
    THINGS.store("other", CONTENT)
    (folder / "other.npz").rename(folder / "key.npz")
    assert THINGS.load("key") is None
    THINGS.store("key", CONTENT)
    assert is_content(THINGS.load("key"))
    assert [path.name for path in folder.iterdir()] == ["key.npz"]


def test_a_folder_that_cannot_be_written_or_a_full_disk_stores_nothing(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "key.npz").mkdir(parents=True)
    THINGS.store("key", CONTENT)
    assert THINGS.load("key") is None and [path.name for path in folder.iterdir()] == ["key.npz"]
    (tmp_path / "file").write_text("in the way")
    with monkeypatch.context() as patch:
        patch.setenv("DATAGEN_CACHE", str(tmp_path / "file"))
        THINGS.store("key", CONTENT)
        assert THINGS.load("key") is None

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    THINGS.store("other", CONTENT)
    assert [path.name for path in folder.iterdir()] == ["key.npz"]


def test_the_least_recently_used_files_are_removed(folder: Path) -> None:
    folder.mkdir(parents=True)
    for name, age_s in ((".half.tmp", 5000), (".young.tmp", 0)):
        (folder / name).write_text("")
        os.utime(folder / name, (time.time() - age_s,) * 2)
    for k in range(6):
        THINGS.store(f"k{k}", CONTENT)
        os.utime(folder / f"k{k}.npz", (k, k))
        if k == 2:
            assert THINGS.load("k0") is not None  # used again
    assert sorted(path.name for path in folder.iterdir()) == [".young.tmp", "k0.npz", "k4.npz", "k5.npz"]


_CHILD = """
import os, sys
from itertools import count
from pathlib import Path
from tests.workers.test_content_cache import CONTENT, THINGS, is_content
readers = Path(sys.argv[1])
for k in count():
    key = f"k{k % 5}"
    found = THINGS.load(key)
    assert found is None or is_content(found)
    if found is not None:  # another process wrote it: ours of five rounds ago was removed
        (readers / str(os.getpid())).touch()
    THINGS.store(key, CONTENT)
    if k >= 100 and len(list(readers.iterdir())) == 2:
        break
"""


def test_processes_that_write_read_and_remove_at_once_see_whole_files(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "readers").mkdir()
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    command = [sys.executable, "-c", _CHILD, str(tmp_path / "readers")]
    started = [subprocess.Popen(command, env=env) for _ in range(2)]
    assert [process.wait(timeout=600) for process in started] == [0, 0]
    left = sorted(path.name for path in folder.iterdir())
    assert 0 < len(left) <= 4 and all(name.startswith("k") for name in left)


def test_a_file_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "below" / "file"
    with pytest.raises(ValueError), whole_file(path) as file:
        file.write(b"half")
        raise ValueError
    assert list(path.parent.iterdir()) == []
    with whole_file(path) as file:
        file.write(b"whole")
        assert not path.exists()
    assert path.read_bytes() == b"whole"


@needs_root
def test_a_user_without_a_home_has_no_cache_in_a_shared_folder() -> None:
    code = "from datagen.workers.content_cache import cache_folder\nprint(cache_folder())"
    assert as_another_user(code, user=54321).split() == ["/dev/null/.cache/datagen"]


def test_a_second_start_of_a_world_reads_no_object(tmp_path: Path) -> None:
    cache, folder = tmp_path / "cache", write_bundle(tmp_path / "set", *(f"{k:03d}_cube" for k in range(9)))

    def start() -> World:
        objects = open_objects(f"ycb:{folder}")
        return assemble_world(small_spec(), open_houses("builtin"), objects, "builtin", str(folder))

    first = start()
    shutil.rmtree(cache / "objects")
    second = start()
    assert not (cache / "objects").exists()
    assert second.target_names == first.target_names == first.object_names
    assert second.objects.digest == first.objects.digest
    shutil.rmtree(cache)
    assert start().target_names == first.target_names

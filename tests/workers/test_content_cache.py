"""A cache that saves time and decides nothing: broken, foreign, blocked and shared by processes."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest

from datagen.schemas.whole_files import whole_file
from datagen.workers.content_cache import Arrays, CacheFolder, alone_in, drop_unused, read_arrays, refresh
from tests.other_user import as_another_user, needs_root

SHELF = CacheFolder(
    "things",
    {"points": (np.float32, ("n", 3)), "weights": (np.float64, ("n",)), "name": (np.str_, ())},
    most_files=3,
    most_bytes=100_000,
)
CONTENT: Arrays = {
    "points": np.arange(12, dtype=np.float32).reshape(4, 3),
    "weights": np.linspace(0, 1, 4),
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


def stored(folder: Path) -> bytes:
    SHELF.store("key", CONTENT)
    return (folder / "key.npz").read_bytes()


def test_what_is_stored_is_what_is_loaded(folder: Path) -> None:
    assert SHELF.load("key") is None
    SHELF.store("key", CONTENT)
    assert is_content(SHELF.load("key"))
    assert [path.name for path in folder.iterdir()] == ["key.npz"]


def test_no_cut_and_no_flipped_bit_is_ever_read_as_something_else(folder: Path) -> None:
    good = stored(folder)
    path = folder / "key.npz"
    for length in range(0, len(good), 7):
        path.write_bytes(good[:length])
        assert SHELF.load("key") is None
    rng = np.random.default_rng(0)
    n_refused = 0
    for place in range(len(good)):
        bad = bytearray(good)
        bad[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(bad)
        found = SHELF.load("key")
        assert found is None or is_content(found)
        n_refused += found is None
    assert n_refused > len(good) / 2


def as_zip(members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def as_npz(**changed: np.ndarray | None) -> bytes:
    buffer = io.BytesIO()
    arrays = {**CONTENT, "key": np.array("key"), **changed}
    np.savez(buffer, **{k: v for k, v in arrays.items() if v is not None})
    return buffer.getvalue()


def test_foreign_files_read_as_absent(folder: Path) -> None:
    stored(folder)
    path = folder / "key.npz"
    path.write_bytes(as_npz())
    assert is_content(SHELF.load("key"))
    members = {f"{name}.npy": b"\x93NUMPY" for name in (*CONTENT, "key") if name != "points"}
    # A header that promises more than any memory holds.
    boast = b"{'descr': '<f4', 'fortran_order': False, 'shape': (99999999999999, 3), }\n"
    start = b"\x93NUMPY\x01\x00" + len(boast).to_bytes(2, "little")
    headers = boast, boast.replace(b"}", b" ")  # and one without its end
    plain = io.BytesIO()
    np.save(plain, CONTENT["points"])
    points, weights = CONTENT["points"], CONTENT["weights"]
    for foreign in (
        b"",
        b"no zip",
        plain.getvalue(),
        as_zip({"readme.txt": b"words"}),
        *(as_zip({"points.npy": start + header, **members}) for header in headers),
        as_zip({"points.npy": b"words"}),
        as_npz(key=np.array("another")),
        as_npz(weights=None),
        as_npz(more=weights),
        as_npz(points=points.astype(np.float64)),
        as_npz(points=points.astype(">f4")),
        as_npz(points=points[:, :2]),
        as_npz(points=points[:3]),
        as_npz(points=points.reshape(-1)),
        as_npz(name=np.array(["cup"], object)),
    ):
        path.write_bytes(foreign)
        assert SHELF.load("key") is None
        SHELF.store("key", CONTENT)  # and is written over
        assert is_content(SHELF.load("key"))


def test_files_beyond_the_size_and_compressed_ones_are_not_read(folder: Path) -> None:
    good = stored(folder)
    path = folder / "key.npz"
    layout = {**SHELF.layout, "key": (np.str_, ())}
    assert read_arrays(path, layout, len(good)) is not None
    assert read_arrays(path, layout, len(good) - 1) is None
    with zipfile.ZipFile(io.BytesIO(good)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    path.write_bytes(as_zip(members))
    assert is_content(SHELF.load("key"))
    path.write_bytes(as_zip(members, zipfile.ZIP_DEFLATED))
    assert SHELF.load("key") is None


def test_a_folder_or_a_pipe_in_the_place_of_a_file_is_left_alone(folder: Path) -> None:
    (folder / "key.npz").mkdir(parents=True)
    assert SHELF.load("key") is None
    SHELF.store("key", CONTENT)
    assert SHELF.load("key") is None and [path.name for path in folder.iterdir()] == ["key.npz"]
    os.mkfifo(folder / "pipe.npz")
    assert SHELF.load("pipe") is None


def test_a_cache_below_a_file_keeps_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("DATAGEN_CACHE", str(tmp_path / "file"))
    SHELF.store("key", CONTENT)
    assert SHELF.load("key") is None


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_a_read_only_folder_is_read_and_not_written(folder: Path) -> None:
    stored(folder)
    folder.chmod(0o500)
    try:
        SHELF.store("other", CONTENT)
        assert SHELF.load("other") is None and is_content(SHELF.load("key"))
    finally:
        folder.chmod(0o700)


def test_a_full_disk_leaves_nothing_behind(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    SHELF.store("key", CONTENT)
    assert list(folder.iterdir()) == []


def test_pruning_keeps_what_was_used_last(folder: Path) -> None:
    for k in range(6):
        SHELF.store(f"k{k}", CONTENT)
        os.utime(folder / f"k{k}.npz", (k, k))
        if k == 2:
            assert SHELF.load("k0") is not None  # used again
            assert (folder / "k0.npz").stat().st_mtime > time.time() - 3600
    assert sorted(path.name for path in folder.iterdir()) == ["k0.npz", "k4.npz", "k5.npz"]


def test_pruning_spares_what_is_in_use_and_clears_what_was_abandoned(tmp_path: Path) -> None:
    now = time.time()
    for k, name in enumerate(["a", "b", "c", "d", ".half.tmp", ".lock"]):
        (tmp_path / name).write_text(name)
        os.utime(tmp_path / name, (now - 5000 + k,) * 2)
    (tmp_path / ".young.tmp").write_text("")
    (tmp_path / "folder").mkdir()
    assert refresh(tmp_path / "a") and not refresh(tmp_path / "gone")
    drop_unused(tmp_path, 2, idle_s=3600)
    assert sorted(p.name for p in tmp_path.iterdir()) == [".lock", ".young.tmp", "a", "d", "folder"]
    refresh(tmp_path / "d")
    drop_unused(tmp_path, 1, idle_s=3600)
    assert (tmp_path / "a").exists() and (tmp_path / "d").exists()
    drop_unused(tmp_path / "gone", 1)


def test_a_file_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "below" / "file"

    def fail() -> None:
        with whole_file(path) as file:
            file.write(b"half")
            raise ValueError

    with pytest.raises(ValueError):
        fail()
    assert list((tmp_path / "below").iterdir()) == []
    with whole_file(path) as file:
        file.write(b"whole")
        assert not path.exists()
    assert path.read_bytes() == b"whole"


_CHILD = """
import os, sys
from itertools import count
from pathlib import Path
from tests.workers.test_content_cache import CONTENT, SHELF, is_content
readers = Path(sys.argv[1])
for k in count():
    key = f"k{k % 5}"
    found = SHELF.load(key)
    assert found is None or is_content(found)
    if found is not None:  # another process wrote it: ours of five rounds ago was pruned
        (readers / str(os.getpid())).touch()
    SHELF.store(key, CONTENT)
    if k >= 300 and len(list(readers.iterdir())) == 3:
        break
"""
_COUNTER = """
import sys
from pathlib import Path
from datagen.workers.content_cache import alone_in
folder = Path(sys.argv[1])
for _ in range(200):
    with alone_in(folder):
        count = int((folder / "count").read_text())
        (folder / "count").write_text(str(count + 1))
"""


def together(code: str, *args: str) -> list[str]:
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    started = [
        subprocess.Popen([sys.executable, "-c", code, *args], env=env, stdout=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    printed = [process.communicate(timeout=600)[0] for process in started]
    assert [process.returncode for process in started] == [0, 0, 0]
    return printed


def test_processes_that_write_read_and_prune_at_once_see_whole_files(folder: Path, tmp_path: Path) -> None:
    """All go on until each has read what another wrote, however long one of them waits for its turn."""
    (tmp_path / "readers").mkdir()
    together(_CHILD, str(tmp_path / "readers"))
    left = sorted(path.name for path in folder.iterdir())
    assert 0 < len(left) <= 5 and all(name.startswith("k") for name in left)


def test_processes_wait_for_one_another(tmp_path: Path) -> None:
    (tmp_path / "count").write_text("0")
    together(_COUNTER, str(tmp_path))
    assert (tmp_path / "count").read_text() == "600"
    with pytest.raises(OSError), alone_in(tmp_path / "gone"):
        pass


@needs_root
def test_a_user_without_a_home_has_no_cache_rather_than_one_that_others_can_write_to() -> None:
    printed = as_another_user(
        "from datagen.workers.content_cache import cache_folder\n"
        "from datagen.schemas.whole_files import whole_file\n"
        "print(cache_folder())\n"
        "try:\n"
        "    with whole_file(cache_folder() / 'x'): print('written')\n"
        "except OSError: print('nowhere')\n",
        user=54321,
    )
    assert printed.split() == ["/dev/null/.cache/datagen", "nowhere"]

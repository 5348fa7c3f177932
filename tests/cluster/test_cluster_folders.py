"""Private folders below /tmp: closed to others, removed at the end, and by the next program after a kill."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from datagen.cluster.cluster_folders import OWNER, RAY, is_alive, private_folder
from tests.other_user import NOBODY, as_another_user, needs_root

# Owns a folder with a process in it, says both, and waits to be killed.
OWNER_PROGRAM = f"""
import os, subprocess, sys
from datagen.cluster.cluster_folders import private_folder
with private_folder() as folder:
    child = subprocess.Popen(["sleep", "inf"], env=os.environ | {{"{OWNER}": str(folder)}})
    print(folder, child.pid, flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def owner() -> Iterator[tuple[subprocess.Popen[str], Path, int]]:
    process = subprocess.Popen(
        [sys.executable, "-c", OWNER_PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        cwd=Path(__file__).resolve().parents[2],
    )  # fmt: skip
    assert process.stdout is not None
    folder, child = process.stdout.readline().split()
    yield process, Path(folder), int(child)
    process.kill()
    process.wait()
    with private_folder():
        pass  # removes what the killed one left


def test_a_folder_is_closed_and_goes_with_its_processes(
    owner: tuple[subprocess.Popen[str], Path, int],
) -> None:
    process, folder, child = owner
    assert folder.stat().st_mode & 0o777 == 0o700 and (folder / RAY).is_dir()
    process.communicate()  # ends its input
    assert process.returncode == 0 and not folder.exists() and not psutil.pid_exists(child)


def test_the_next_program_removes_what_a_killed_one_left_and_nothing_of_a_living_one(
    owner: tuple[subprocess.Popen[str], Path, int],
) -> None:
    process, folder, child = owner
    process.send_signal(signal.SIGSTOP)  # silent, but alive
    with private_folder():
        assert folder.exists() and psutil.pid_exists(child)
    process.kill()
    process.wait()
    assert folder.exists() and psutil.pid_exists(child)
    with private_folder() as own:
        assert not folder.exists() and not psutil.pid_exists(child) and own.exists()


def test_a_killed_process_is_alive_only_while_it_can_be_recognised() -> None:
    """One that ends has no environment left before it is a zombie, so no later look would find it."""
    for _ in range(20):
        child = subprocess.Popen([sys.executable, "-c", "print(flush=True); input()"], stdin=-1, stdout=-1)
        assert child.stdout is not None and child.stdout.readline()
        process = psutil.Process(child.pid)
        assert is_recognised(process) and is_alive(process)
        child.kill()
        while is_recognised(process):
            pass
        assert not is_alive(process)
        child.communicate()
        assert not is_alive(process)


def is_recognised(process: psutil.Process) -> bool:
    try:
        return bool(process.environ())
    except psutil.Error:
        return False


@needs_root
def test_folders_of_others_and_planted_links_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "ray").mkdir()
    planted = Path(tempfile.mkdtemp(prefix="datagen-ray-planted-", dir="/tmp"))
    link = planted.with_name(f"{planted.name}-link")
    try:
        (planted / RAY).mkdir()
        os.chown(planted, NOBODY, NOBODY)
        link.symlink_to(tmp_path)
        with private_folder() as folder:
            assert (planted / RAY).is_dir() and (tmp_path / "ray").is_dir() and link.is_symlink()
            tried = as_another_user(
                "from pathlib import Path\n"
                "for act in (lambda p: list(p.iterdir()), lambda p: (p / 'planted').symlink_to('/etc'),\n"
                "            lambda p: (p / 'ray' / 'logs').mkdir(), lambda p: p.rename('/tmp/taken')):\n"
                "    try: print(act(Path(sys.argv[1])))\n"
                "    except PermissionError: print('refused')\n",
                folder,
            )
            assert tried.split() == ["refused"] * 4
    finally:
        link.unlink(missing_ok=True)
        shutil.rmtree(planted)

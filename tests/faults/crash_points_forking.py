"""Children of a process that has everything imported, and copies of the folders that they change."""

from __future__ import annotations

import os
import shutil
import sys
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path

from datagen.schemas.errors import InputError

REFUSED, DEFECT = 3, 4
Files = Mapping[str, bytes]


def must(do: Callable[[], None]) -> None:
    """Do it in a forked child; RuntimeError with what it failed with."""
    status, told = in_child(do)
    if status != 0:
        raise RuntimeError(told)


def in_child(do: Callable[[], str | None]) -> tuple[int, str]:
    """Do it in a forked child: (exit status, negative for a signal; what it returned or failed with)."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        status, told = DEFECT, ""
        try:
            os.close(reading)
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())  # progress
            told, status = do() or "", 0
        except InputError as e:
            told, status = str(e), REFUSED
        except BaseException:  # noqa: BLE001 - whatever it is must not come back into the parent's code
            told = traceback.format_exc()
        finally:
            with os.fdopen(writing, "w") as f:
                f.write(told)
            os._exit(status)
    os.close(writing)
    with os.fdopen(reading) as f:
        told = f.read()
    _, ended = os.waitpid(pid, 0)
    return os.waitstatus_to_exitcode(ended), told


def copy_tree(source: Path, target: Path) -> None:
    """A copy in place of what is there; none where there is no source."""
    shutil.rmtree(target, ignore_errors=True)
    if source.exists():
        shutil.copytree(source, target)


def files_below(folder: Path) -> dict[str, bytes]:
    """Every file by its path in the folder."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def bytes_of(path: Path) -> bytes | None:
    """The file's bytes, or None where there is none."""
    return path.read_bytes() if path.is_file() else None

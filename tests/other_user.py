"""Another user of this machine, and where a secret can be seen."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest

NOBODY = 65534
REPOSITORY = Path(__file__).resolve().parents[1]
needs_root = pytest.mark.skipif(os.getuid() != 0, reason="only root can act as another user")


def as_another_user(code: str, *arguments: object, user: int = NOBODY) -> str:
    """What Python code prints as another user id, which it takes on after its imports."""
    become = f"import os, sys; os.setgroups([]); os.setgid({user}); os.setuid({user})\n"
    imports = "".join(f"{line}\n" for line in code.splitlines() if line.startswith(("import ", "from ")))
    environment = {"PATH": os.environ["PATH"], "RAY_AUTH_MODE": "disabled"}
    done = subprocess.run(
        [sys.executable, "-c", imports + become + code, *map(str, arguments)],
        check=False, env=environment, cwd=REPOSITORY, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def traces_of(secret: str, folders: Iterable[Path]) -> list[str]:
    """Command lines of any process, and files of the folders, in which a secret stands."""
    found: list[str] = []
    for place in [*Path("/proc").glob("[0-9]*/cmdline"), *(f for d in folders for f in d.rglob("*"))]:
        try:
            if place.is_file() and secret.encode() in place.read_bytes():
                found.append(str(place))
        except OSError:
            continue  # a process or a file that went, or a socket
    return found

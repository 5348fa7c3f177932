"""Makes the project's virtual environment, .venv, with the versions that constraints.txt pins.

Only the standard library is used. A second call finds its stamp and returns at once. The stamp names
what pyproject.toml asks for, constraints.txt, the interpreter and the folder: when one of them changes,
the environment is made anew; settings of linters and tests change nothing in it.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
ENVIRONMENT = ROOT / ".venv"
STAMP = ENVIRONMENT / "installed.sha256"
OLDEST = (3, 11)


def fingerprint() -> str:
    """sha256 over everything that decides what is installed."""
    # Not at the top: an interpreter too old to have it shall reach the message about its age.
    import tomllib

    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text())
    asked = {key: pyproject[key] for key in ("build-system", "project")}
    asked["setuptools"] = pyproject["tool"]["setuptools"]
    parts = [sys.version, sys.prefix, str(ROOT), json.dumps(asked, sort_keys=True)]
    parts.append((ROOT / "constraints.txt").read_text())
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def create() -> list[str]:
    """A bare environment, and the pip command that installs into it.

    Debian's python3 can come without ensurepip; the pip that belongs to it then installs from outside.
    """
    shutil.rmtree(ENVIRONMENT, ignore_errors=True)
    python = str(ENVIRONMENT / "bin" / "python")
    if importlib.util.find_spec("ensurepip") is not None:
        made = subprocess.run([sys.executable, "-m", "venv", str(ENVIRONMENT)], check=False)
        if made.returncode == 0:
            return [python, "-m", "pip"]
        shutil.rmtree(ENVIRONMENT, ignore_errors=True)
    if importlib.util.find_spec("pip") is None:
        sys.exit("error: this python has neither ensurepip nor pip: apt-get install python3-venv")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(ENVIRONMENT)], check=True)
    return [sys.executable, "-m", "pip", "--python", python]


def main() -> int:
    """Check the interpreter, create and fill the environment, stamp it, check the system's libraries."""
    if sys.version_info < OLDEST:
        running = ".".join(str(part) for part in sys.version_info[:3])
        wanted = ".".join(str(part) for part in OLDEST)
        sys.exit(
            f"error: python {wanted} or newer is needed, this is {running} ({sys.executable}); "
            f"name another: make PYTHON=python{wanted}"
        )
    wanted_stamp = fingerprint()
    if STAMP.is_file() and STAMP.read_text().strip() == wanted_stamp:
        return 0
    print("making .venv with pinned libraries; the first time takes some minutes", flush=True)
    pip = create()
    install = ["install", "-qq", "--disable-pip-version-check", "-c", str(ROOT / "constraints.txt")]
    filled = subprocess.run([*pip, *install, "-e", f"{ROOT}[sim,train,detect,docs,dev]"], check=False)
    if filled.returncode:
        print("error: pip could not install the pinned libraries; see its message above", file=sys.stderr)
        return 1
    subprocess.run([sys.executable, str(ROOT / "scripts" / "system_libraries.py")], check=True)
    STAMP.write_text(wanted_stamp + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

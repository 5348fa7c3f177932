"""Make the project's virtual environment, .venv, with the versions that constraints.txt pins.

    python3 scripts/environment.py [EXTRA...]

The extras are those of pyproject.toml; all of them where none is named. Only the standard library is used.
A later call returns at once where the environment holds the extras, and adds those that it lacks. The
environment is made again when the requirements in pyproject.toml, constraints.txt, the interpreter or the
folder change; settings of linters and tests do not matter.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import queue
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
ENVIRONMENT = ROOT / ".venv"
STAMP = ENVIRONMENT / "installed.json"
OLDEST = (3, 11)
EVERYTHING = ("all", "dev", "docs")
# It pins a library that nothing imports, without wheels from this Python on (docs/development/decisions.md).
ALONE, ALONE_FROM = "mani-skill", (3, 13)
# Seconds between two lines of progress, on a terminal (where each replaces the last) and elsewhere.
ON_TERMINAL_S, ELSEWHERE_S = 0.5, 15.0


def fingerprint() -> str:
    """sha256 over everything that decides what is installed, except the extras."""
    # Not at the top: an interpreter too old to have it must reach the message about its version.
    import tomllib

    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text())
    required = {key: pyproject[key] for key in ("build-system", "project")}
    required["setuptools"] = pyproject["tool"]["setuptools"]
    parts = [sys.version, sys.prefix, str(ROOT), json.dumps(required, sort_keys=True)]
    parts.append((ROOT / "constraints.txt").read_text())
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def leave_environment() -> None:
    """Go on with the interpreter below .venv where that is activated: its own may be removed here."""
    if Path(sys.prefix).resolve() == ENVIRONMENT:
        below = str(getattr(sys, "_base_executable"))  # noqa: B009  the name is private
        os.execv(below, [below, *sys.argv])


def installed_extras(wanted: str) -> set[str]:
    """The extras of the environment, where it has this fingerprint; else none."""
    try:
        stamp = json.loads(STAMP.read_text())
        return set(stamp["extras"]) if stamp["fingerprint"] == wanted else set()
    except (OSError, ValueError, KeyError, TypeError):
        return set()


def create() -> None:
    """Make a bare environment, with pip where this interpreter brings it (Debian's can come without)."""
    shutil.rmtree(ENVIRONMENT, ignore_errors=True)
    if importlib.util.find_spec("ensurepip") is not None:
        made = subprocess.run([sys.executable, "-m", "venv", str(ENVIRONMENT)], check=False)
        if made.returncode == 0:
            return
        shutil.rmtree(ENVIRONMENT, ignore_errors=True)
    if importlib.util.find_spec("pip") is None:
        sys.exit("error: this python has neither ensurepip nor pip: apt-get install python3-venv")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(ENVIRONMENT)], check=True)


def pip_command() -> list[str]:
    """The environment's own pip, or this interpreter's, which then installs from outside."""
    python = str(ENVIRONMENT / "bin" / "python")
    if any(ENVIRONMENT.glob("lib/python*/site-packages/pip")):
        return [python, "-m", "pip"]
    return [sys.executable, "-m", "pip", "--python", python]


def install(arguments: list[str]) -> bool:
    """Run `pip install` and report its progress; False where it failed, after pip's own message."""
    command = [
        *pip_command(),
        "install",
        "--disable-pip-version-check",
        "--no-input",
        "--progress-bar",
        "off",
    ]
    started = time.monotonic()
    process = subprocess.Popen([*command, *arguments], stdout=subprocess.PIPE, text=True, errors="replace")
    lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()

    def read() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            lines.put(line)
        lines.put(None)

    threading.Thread(target=read, daemon=True).start()
    terminal = sys.stdout.isatty()
    progress, pause_s = Progress(_count()), ON_TERMINAL_S if terminal else ELSEWHERE_S
    due = started + pause_s
    while True:
        try:
            line = lines.get(timeout=max(0.0, due - time.monotonic()))
            if line is None:
                break
            progress.read(line)
        except queue.Empty:
            report = f"{time.monotonic() - started:4.0f} s: {progress.text(_count())}"
            print(f"\r\x1b[K{report[:100]}" if terminal else report, end="" if terminal else "\n", flush=True)
            due = time.monotonic() + pause_s
    code = process.wait()
    print("\r\x1b[K" if terminal else "", end="", flush=True)
    return code == 0


class Progress:
    """How far pip is, from the lines that it prints and the packages that lie in the environment."""

    def __init__(self, before: int) -> None:
        self.before = before  # packages in the environment at the start
        self.found: set[str] = set()
        self.latest = ""
        self.to_install = 0

    def read(self, line: str) -> None:
        """Process one line of pip's output."""
        first, _, rest = line.strip().partition(" ")
        if first == "Collecting" and rest:
            self.latest = rest.split(" ")[0]
            self.found.add(self.latest.partition("=")[0])
        elif first == "Downloading" and rest:
            self.latest = rest.rpartition("/")[2]
        elif line.startswith("Installing collected packages: "):
            self.to_install = line.count(",") + 1

    def text(self, count: int) -> str:
        """One line, where the environment holds `count` packages now."""
        if self.to_install:
            return f"{max(0, count - self.before)} of {self.to_install} packages installed"
        return f"{len(self.found)} packages found" + (f", downloading {self.latest}" if self.latest else "")


def _count() -> int:
    return sum(1 for _ in ENVIRONMENT.glob("lib/python*/site-packages/*.dist-info"))


def _pin(package: str) -> str:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    return next(line.partition(";")[0].strip() for line in lines if line.startswith(f"{package}=="))


def main(arguments: list[str]) -> int:
    """Check the interpreter, create and fill the environment, stamp it, check the system's libraries."""
    running = ".".join(str(part) for part in sys.version_info[:3])
    if sys.version_info < OLDEST:
        wanted = ".".join(str(part) for part in OLDEST)
        sys.exit(
            f"error: python {wanted} or newer is needed, this is {running} ({sys.executable}); "
            f"name another: make PYTHON=python{wanted}"
        )
    requested = set(arguments or EVERYTHING)
    wanted = fingerprint()
    present = installed_extras(wanted)
    if requested <= present or set(EVERYTHING) <= present:
        return 0
    started = time.monotonic()
    extras = ",".join(sorted(requested | present))
    print(f"installing {extras} with pinned versions into .venv, for python {running}", flush=True)
    if not present:
        create()
    STAMP.unlink(missing_ok=True)
    pins = ["-c", str(ROOT / "constraints.txt")]
    done = install([*pins, "-e", f"{ROOT}[{extras}]"])
    if done and requested & {"all", "sim"} and sys.version_info >= ALONE_FROM:
        done = install([*pins, "--no-deps", _pin(ALONE)])
    if not done:
        print("error: pip could not install the pinned libraries; see its message above", file=sys.stderr)
        return 1
    subprocess.run([sys.executable, str(ROOT / "scripts" / "system_libraries.py")], check=True)
    STAMP.write_text(json.dumps({"fingerprint": wanted, "extras": sorted(requested | present)}) + "\n")
    print(f"{_count()} packages in .venv after {time.monotonic() - started:.0f} s", flush=True)
    return 0


if __name__ == "__main__":
    leave_environment()
    sys.exit(main(sys.argv[1:]))
